"""Snapshots by replay, for simulators that cannot be copied (Box2D)."""

import functools
import inspect
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.handlers import HANDLERS, handler_of
from sb3_mcbs.snapshot.layers import NOT_STATE, RECORDER, capture_attributes, restore_attributes
from sb3_mcbs.snapshot.object_graph import Capture, Node, Ref, Restore, private_copy
from sb3_mcbs.snapshot.registry import SnapshotAdapter


class RecordedEpisode(NamedTuple):
    """What has to be replayed.

    :param attributes: attributes of the environment just before its reset, generators included.
    :param nodes: the nodes that ``attributes`` refers to.
    :param reset: keyword arguments of the reset.
    :param actions: what the environment was stepped with since.
    """

    attributes: dict[str, Any]
    nodes: tuple[Node, ...]
    reset: dict[str, Any]
    actions: tuple[Any, ...]


class Recorder:
    """Stands in for the ``reset`` and ``step`` of one environment and records the episode.

    It is put on the environment itself, below every wrapper, so that it also sees what does not
    come through a ``SnapshotEnvWrapper``.

    :param env: the environment.
    :param prepare: called with the environment before each reset.
    :param not_state: names of attributes that are not put back before a replay.
    """

    def __init__(self, env: Any, prepare: Callable[[Any], None] | None, not_state: frozenset[str]) -> None:
        self.env = env
        self._prepare = prepare
        self._not_state = NOT_STATE | not_state
        self.episode: RecordedEpisode | None = None
        self.actions: list[Any] = []
        #: Whether steps were taken that no record of an episode began with.
        self.unrecorded = False
        #: Whether it is in a state that no record leads to: it has to be reset before it is stepped.
        self.must_reset = False
        self._reset = env.reset
        self._step = env.step
        # Many environments step once in their reset, and that step must not be recorded as well.
        self._inside = False
        # A copy of the environment is to call the copy of this object, so that it must not be closed over.
        env.reset = functools.update_wrapper(functools.partial(Recorder.reset, self), env.reset)
        env.step = functools.update_wrapper(functools.partial(Recorder.step, self), env.step)
        setattr(env, RECORDER, self)

    def reset(self, **arguments: Any) -> Any:
        """Reset the environment and begin a record.

        :param arguments: of the environment's ``reset``.
        :return: what the environment returns.
        """
        if not self._inside:
            self.begin(arguments)
            return self._begin_episode(arguments)
        return self._reset(**arguments)

    def step(self, action: Any) -> Any:
        """Step the environment and record the action.

        :param action: of the environment's ``step``.
        :return: what the environment returns.
        """
        if not self._inside:
            if self.must_reset:
                raise SnapshotUnsupportedError(_unrecorded(self.env))
            self.unrecorded = self.episode is None
            self.actions.append(private_copy(action))
        return self._call(self._step, action)

    def _begin_episode(self, arguments: dict[str, Any]) -> Any:
        if self._prepare is not None:
            self._prepare(self.env)
        return self._call(self._reset, **arguments)

    def _call(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        inside, self._inside = self._inside, True
        try:
            return function(*arguments, **named)
        finally:
            self._inside = inside

    def begin(self, arguments: dict[str, Any]) -> None:
        """Begin a record.

        :param arguments: of the reset that follows.
        """
        capture = Capture(handler_of, {id(self.env): Ref(0)}, 1)
        attributes = capture_attributes(capture, self.env, self._not_state, skip_unsupported=True)
        self.episode = RecordedEpisode(attributes, tuple(capture.nodes), private_copy(arguments), ())
        self.actions = []
        self.unrecorded = self.must_reset = False

    def replay(self, episode: RecordedEpisode) -> None:
        """Repeat an episode on the environment.

        :param episode: what to repeat.
        """
        restore = Restore(episode.nodes, HANDLERS, [self.env], "restore")
        restore_attributes(restore, self.env, self._not_state, episode.attributes, delete_others=False)
        restore.commit()
        render_mode, self.env.render_mode = self.env.render_mode, None
        try:
            self._begin_episode(private_copy(episode.reset))
            for action in episode.actions:
                self._call(self._step, private_copy(action))
        finally:
            self.env.render_mode = render_mode
        self.episode = episode._replace(actions=())
        self.actions = list(episode.actions)
        self.unrecorded = self.must_reset = False


class ReplayAdapter(SnapshotAdapter):
    """Restores an environment by repeating its episode from the reset on.

    For environments whose simulator cannot be copied and that always do the same when they start
    from the same random state and get the same actions. Exact, but a restore costs as much as
    all steps of the episode so far; the first one says so.

    The environment's Python attributes are put back afterwards, where they can be captured. What is
    done to the simulator other than through the environment's ``reset`` and ``step`` is not repeated.

    :param prepare: called with the environment before each reset, the live ones included. It has to make
        the episode independent of those before it where the environment does not do so itself.
    """

    with_attributes = True
    what = "the episode's actions, which every restore repeats"
    not_state = frozenset({"reset", "step", RECORDER})

    def __init__(self, prepare: Callable[[Any], None] | None = None) -> None:
        self._prepare = prepare
        self._told: set[type] = set()
        # A subclass names its own.
        self.not_state = ReplayAdapter.not_state | type(self).not_state

    def attach(self, env: Any) -> None:
        if find_recorder(env) is None:
            constructor_arguments(env)
            Recorder(env, self._prepare, self.not_state)

    def capture(self, obj: Any) -> RecordedEpisode | None:
        recorder = find_recorder(obj)
        if recorder is None:
            raise SnapshotUnsupportedError(
                f"a {type(obj).__name__} is restored by replay, which is possible only where it is the "
                "environment itself"
            )
        if recorder.unrecorded:
            raise SnapshotUnsupportedError(_unrecorded(obj))
        if recorder.episode is None:
            return None
        return recorder.episode._replace(actions=tuple(recorder.actions))

    def restore(self, obj: Any, state: RecordedEpisode | None) -> None:
        recorder = find_recorder(obj)
        assert recorder is not None, "attach() comes before restore()"
        if state is None:
            recorder.episode, recorder.actions = None, []
            recorder.must_reset, recorder.unrecorded = True, False
            return
        start = time.perf_counter()
        recorder.replay(state)
        self._tell(obj, len(state.actions), time.perf_counter() - start)

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        arguments = constructor_arguments(obj)
        made = type(obj)(*arguments.args, **arguments.kwargs)
        made.spec = obj.spec
        made.render_mode = None
        return made

    def _tell(self, env: Any, n_steps: int, seconds: float) -> None:
        if type(env) in self._told:
            return
        self._told.add(type(env))
        warnings.warn(
            f"The simulator of {type(env).__name__} cannot be copied, so its snapshots are restored by "
            f"repeating the episode: this restore took {1e3 * seconds:.2f} ms for {n_steps} steps, and later "
            "in an episode it takes longer.",
            stacklevel=2,
        )


def _unrecorded(env: Any) -> str:
    return (
        f"a {type(env).__name__} is restored by replay, and the reset of this episode was not recorded: it "
        "was before the environment was wrapped. Reset it"
    )


def find_recorder(env: Any) -> Any:
    """Return what records the episodes of an environment, None if nothing does.

    :param env: the environment.
    """
    return vars(env).get(RECORDER)


def constructor_arguments(env: Any, what: str = "is restored by replay") -> inspect.BoundArguments:
    """Find the arguments that make another environment like this one, which draws nothing.

    :param env: the environment.
    :param what: what is done with the environment, for the error.
    :raises SnapshotUnsupportedError: if they cannot be found out.
    """
    signature = inspect.signature(type(env))
    try:
        bound = _bind(env, signature)
    except TypeError as error:
        raise _unknown_arguments(env, what, str(error)) from error
    for name, value in bound.arguments.items():
        if name == "render_mode":
            bound.arguments[name] = None
        elif signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD and "render_mode" in value:
            bound.arguments[name] = {**value, "render_mode": None}
    return bound


def _bind(env: Any, signature: inspect.Signature) -> inspect.BoundArguments:
    """Find the arguments that an environment was made with.

    :raises TypeError: if what is known does not fit its constructor.
    """
    kept = hasattr(env, "_ezpickle_args")
    if kept and _keeps_own_arguments(type(env)):
        return signature.bind(*env._ezpickle_args, **env._ezpickle_kwargs)
    if env.spec is not None and (not kept or _maker(env.spec.entry_point) is type(env)):
        return signature.bind(**env.spec.kwargs)
    if kept and signature.parameters.keys() - {"render_mode"}:
        raise TypeError(f"those that EzPickle kept are a base class's, not those of {signature}")
    return signature.bind()


def _keeps_own_arguments(cls: type) -> bool:
    """Return whether what ``EzPickle`` keeps are the arguments of a class's own constructor.

    A constructor that leaves this to that of a base class may give it other arguments than it got.

    :param cls: a class that derives from ``EzPickle``.
    """
    own, *others = [base for base in cls.__mro__ if "__init__" in vars(base)]
    if gym.utils.EzPickle in (own, *others[:1]):
        return True
    code = getattr(inspect.unwrap(own.__init__), "__code__", None)  # type: ignore[misc]
    return code is not None and gym.utils.EzPickle.__name__ in code.co_names


def _maker(entry_point: Any) -> Any:
    return entry_point if callable(entry_point) else load_env_creator(entry_point)


def _unknown_arguments(env: Any, what: str, reason: str) -> SnapshotUnsupportedError:
    name = type(env).__name__
    return SnapshotUnsupportedError(
        f"{name} {what}, and for clones the arguments of its constructor must be known: "
        f"{reason}. Register {name} and use gymnasium.make, or derive it from gymnasium.utils.EzPickle and "
        "end its __init__ with EzPickle.__init__(self, <the same arguments>)."
    )


class Box2DAdapter(ReplayAdapter):
    """Replays environments that hold a Box2D world."""

    # CarRacing shares the colours in it with the world's bodies, which only the replay can share again.
    not_state = ReplayAdapter.not_state | {"road_poly"}


def uses_box2d(env: Any) -> bool:
    """Return whether an object is an environment that holds a Box2D world.

    :param env: an environment, a wrapper, or an object that one holds.
    """
    if not isinstance(env, gym.Env) or isinstance(env, gym.Wrapper):
        return False
    return any(type(value).__module__.partition(".")[0] == "Box2D" for value in vars(env).values())


def renew_world(env: Any) -> None:
    """Give a Box2D environment of Gymnasium a new world.

    A world in which an episode has been simulated is not as it was, even when all bodies are gone: what
    follows depends on it in the last bits. LunarLander makes a new one at each reset, the others do not.

    :param env: the environment.
    """
    if not any(cls.__module__.startswith("gymnasium.envs.box2d.") for cls in type(env).__mro__):
        return
    env._destroy()
    listener = getattr(env, "contactListener_keepref", None)
    gravity = env.world.gravity
    env.world = type(env.world)(gravity=gravity)
    if listener is not None:
        env.world.contactListener = listener
