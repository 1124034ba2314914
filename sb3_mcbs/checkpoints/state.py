"""The state of a whole run: agent, replay buffer, environments, callbacks and logger, in one graph."""

import time
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.attributes import SearchAttributes
from sb3_mcbs.agents.observation_pipeline import snapshot_environments
from sb3_mcbs.checkpoints.components import components, layers_of, not_state_of
from sb3_mcbs.checkpoints.encoding import Decoder, Encoded, Encoder, in_section, of_section
from sb3_mcbs.checkpoints.environments import (
    capture_environment,
    read_generators,
    restore_environment,
    set_generators,
    write_monitor_files,
)
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import file_of, open_log_files, read_written, results_file, write_again
from sb3_mcbs.checkpoints.handlers import HANDLERS, handler_of
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.models import Environments, WorkerEnvironments
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.layers import capture_attributes, restore_attributes
from sb3_mcbs.snapshot.object_graph import Capture, Ref, Restore, class_name

RUN = "run"
_POLICY = "policy"


class Captured(NamedTuple):
    """The state of a run as data.

    :param json: by section: the run, and each environment.
    :param arrays: by section and dtype.
    """

    json: dict[str, Any]
    arrays: dict[str, np.ndarray]


class RunState:
    """Reads and sets the state of a run. The replay buffer's rows are not part of it.

    Environments in this process are wrapped for snapshots in place.

    :param agent: the agent that learns.
    :param callback: the callback of its ``learn``.
    :raises ValueError: if environments in worker processes are not wrapped for snapshots.
    """

    def __init__(self, agent: OffPolicyAlgorithm, callback: BaseCallback) -> None:
        self._agent = agent
        self._components = components(agent, callback)
        self._bases = self._find_bases()
        self._environments: dict[str, Environments] = {
            name: snapshot_environments(base) for name, base in self._bases.items()
        }

    def _find_bases(self) -> dict[str, VecEnv]:
        bases = {}
        for name, part in self._components.items():
            if isinstance(part, VecEnv) and list(layers_of(part)) == [part]:
                bases[name] = part
        return bases

    @property
    def worker_environments(self) -> list[SubprocVecEnv]:
        """The vectorized environments whose environments are in processes of their own."""
        return [base for base in self._bases.values() if isinstance(base, SubprocVecEnv)]

    @property
    def class_names(self) -> dict[str, str]:
        """The class of every component, by name."""
        return {name: class_name(type(part)) for name, part in self._components.items()}

    def verify(self) -> None:
        """Check that the state of every environment that has been reset can be captured exactly.

        :raises SnapshotUnsupportedError: if that of one cannot.
        """
        for environments in self._environments.values():
            environments.apply(range(len(environments)), SnapshotEnvWrapper.verify)

    def capture(self) -> Captured:
        """Read the state.

        :raises CheckpointError: if part of it cannot be written as data; names the attribute.
        """
        sections: dict[str, Encoded] = {RUN: self._encode()[1]}
        for name, environments in self._environments.items():
            in_workers = isinstance(environments, WorkerEnvironments)
            captured = environments.apply(range(len(environments)), capture_environment, in_workers)
            sections |= {f"{name}[{index}]": encoded for index, encoded in enumerate(captured)}
        networks = self._agent.policy.state_dict()
        arrays = in_section(_POLICY, {name: tensor.cpu().numpy() for name, tensor in networks.items()})
        for section, encoded in sections.items():
            arrays |= in_section(section, encoded.arrays)
        return Captured({section: encoded.json for section, encoded in sections.items()}, arrays)

    def restore(self, captured: Captured, classes: tuple[Any, ...] = ()) -> None:
        """Put the run into a state.

        :param captured: from :meth:`capture` of a run that was set up the same way.
        :param classes: classes and functions that the checkpoint may refer to, besides SB3's and those that
            this run uses.
        :raises CheckpointError: if the state is of another run.
        """
        own = [f"{name}[{index}]" for name, envs in self._environments.items() for index in range(len(envs))]
        if set(captured.json) != {RUN, *own}:
            raise CheckpointError(
                f"The checkpoint holds {sorted(captured.json)}, this run consists of {sorted([RUN, *own])}."
            )
        monitors = {}
        for name, environments in self._environments.items():
            indices = range(len(environments))
            arguments = [(_section(captured, f"{name}[{index}]"), classes) for index in indices]
            monitors[name] = environments.apply_each(indices, restore_environment, arguments)
        set_networks(self._agent, captured.arrays)
        rest = self._decode(_section(captured, RUN), classes)
        # Files come after all that may be refused: a run that does not go on leaves them as they were.
        for name, environments in self._environments.items():
            contents = [(written,) for written in monitors[name]]
            environments.apply_each(range(len(environments)), write_monitor_files, contents)
        self._set_rest(rest)

    def _encode(self) -> tuple[Encoder, Encoded]:
        parts = self._components
        capture = Capture(handler_of, {id(part): Ref(i) for i, part in enumerate(parts.values())}, len(parts))
        encoder = Encoder()
        attributes: dict[str, Any] = {}
        nodes: list[Any] = []
        for name, part in parts.items():
            try:
                captured = capture_attributes(capture, part, not_state_of(part), skip_unsupported=False)
                attributes[name] = encoder.encode(captured)
                nodes += encoder.encode_nodes(tuple(capture.nodes[len(nodes) :]))
            except (SnapshotUnsupportedError, CheckpointError) as error:
                raise CheckpointError(_refusal(name, part, error)) from error
        rest = {
            "seconds": (time.time_ns() - self._agent.start_time) / 1e9,
            "searchers": {name: searcher.memory for name, searcher in self._searchers().items()},
            "files": {name: self._written(part) for name, part in parts.items()},
            "generators": read_generators(),
        }
        data = {
            "attributes": attributes,
            "rest": encoder.encode(rest),
            "nodes": nodes,
        }
        return encoder, Encoded(data, encoder.arrays)

    def _decode(self, encoded: Encoded, classes: tuple[Any, ...]) -> dict[str, Any]:
        parts = self._components
        names = {**known_names(classes), **self._encode()[0].names}
        decoder = Decoder(encoded.arrays, names)
        restore = Restore(
            decoder.decode_nodes(encoded.json["nodes"]), HANDLERS, list(parts.values()), "restore"
        )
        if encoded.json["attributes"].keys() != parts.keys():
            raise CheckpointError("The checkpoint's run has other parts than this one.")
        try:
            for name, part in parts.items():
                saved = decoder.decode(encoded.json["attributes"][name])
                not_state = not_state_of(part, saved)
                attributes = {key: value for key, value in saved.items() if key not in not_state}
                restore_attributes(restore, part, not_state, attributes, delete_others=True)
        except SnapshotError as error:
            raise CheckpointError(
                f"The checkpoint is of a run that was set up differently: {error}"
            ) from error
        rest = decoder.decode(encoded.json["rest"])
        restore.commit()
        return rest

    def _set_rest(self, rest: dict[str, Any]) -> None:
        agent = self._agent
        agent.start_time = time.time_ns() - int(rest["seconds"] * 1e9)
        for part in self._components.values():
            if isinstance(part, SearchAttributes | SearchPolicy):  # a callback may have changed its settings
                part._follow_settings()
        for name, searcher in self._searchers().items():
            searcher.memory = rest["searchers"][name]
        open_log_files(agent.logger)
        for name, written in rest["files"].items():
            if written is not None:
                write_again(self._file(self._components[name]), written)
        # Last, since whatever is made on the way may draw from them.
        set_generators(rest["generators"])

    def _searchers(self) -> dict[str, Any]:
        found = {}
        for name, part in self._components.items():
            searcher = vars(part).get("_searcher", vars(part).get("searcher"))
            if searcher is not None and not isinstance(part, th.nn.Module):
                found[name] = searcher
        return found

    def _file(self, part: Any) -> Any:
        if isinstance(part, KVWriter):
            return file_of(part)
        return results_file(part) if isinstance(part, VecMonitor) else None

    def _written(self, part: Any) -> np.ndarray | None:
        file = self._file(part)
        return None if file is None else read_written(file)


def set_networks(agent: OffPolicyAlgorithm, arrays: dict[str, np.ndarray]) -> None:
    """Give an agent the networks of a checkpoint.

    :param agent: the agent.
    :param arrays: of :class:`Captured`.
    :raises CheckpointError: if they are other networks.
    """
    tensors = {name: th.from_numpy(array) for name, array in of_section(_POLICY, arrays).items()}
    try:
        agent.policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"The networks of the checkpoint are not those of this agent: {error}"
        ) from error


def _section(captured: Captured, name: str) -> Encoded:
    return Encoded(captured.json[name], of_section(name, captured.arrays))


def _refusal(name: str, part: Any, error: Exception) -> str:
    path = "".join(getattr(error, "path", ()))
    reason = getattr(error, "reason", str(error))
    return (
        f"{path or type(part).__name__} (in {name}) cannot be part of a checkpoint: {reason}. Leave it "
        "out of "
        "the class's state (list its name in a class attribute not_checkpointed), or register a pair of "
        "functions for its class with sb3_mcbs.checkpoints.register_state."
    )
