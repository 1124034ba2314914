"""The state of a whole run: agent, replay buffer, environments, callbacks and logger, in one graph."""

import time
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_mcbs.agents.observation_pipeline import snapshot_environments
from sb3_mcbs.agents.resumable import Searching
from sb3_mcbs.checkpoints.components import components, not_state_of
from sb3_mcbs.checkpoints.encoding import Decoder, Encoded, Encoder, in_section, of_section
from sb3_mcbs.checkpoints.environments import (
    capture_environment,
    read_generators,
    restore_environment,
    set_generators,
    write_monitor_files,
)
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import file_of, open_log_files, read_written, write_again
from sb3_mcbs.checkpoints.handlers import HANDLERS, handler_of
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.models import WorkerEnvironments
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.layers import capture_attributes, restore_attributes
from sb3_mcbs.snapshot.object_graph import Capture, Ref, Restore, class_name

RUN = "run"
_POLICY = "policy"


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
        self._environments = {
            name: snapshot_environments(part)
            for name, part in self._components.items()
            if isinstance(part, VecEnv) and not isinstance(part, VecEnvWrapper)
        }

    @property
    def in_workers(self) -> list[SubprocVecEnv]:
        """The vectorized environments whose environments are in processes of their own."""
        return [envs.vec_env for envs in self._environments.values() if isinstance(envs, WorkerEnvironments)]

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

    def capture(self) -> Encoded:
        """Read the state.

        :return: by section: the run, and each environment. The networks are among the arrays only.
        :raises CheckpointError: if part of it cannot be written as data; names the attribute.
        """
        sections = {RUN: self._encode(Encoder())}
        for name, environments in self._environments.items():
            in_workers = isinstance(environments, WorkerEnvironments)
            captured = environments.apply(range(len(environments)), capture_environment, in_workers)
            sections |= {f"{name}[{index}]": encoded for index, encoded in enumerate(captured)}
        networks = self._agent.policy.state_dict()
        arrays = in_section(_POLICY, {name: tensor.cpu().numpy() for name, tensor in networks.items()})
        for section, encoded in sections.items():
            arrays |= in_section(section, encoded.arrays)
        return Encoded({section: encoded.json for section, encoded in sections.items()}, arrays)

    def restore(self, state: Encoded, classes: tuple[Any, ...] = ()) -> None:
        """Put the run into a state.

        :param state: from :meth:`capture` of a run that was set up the same way.
        :param classes: classes and functions that the checkpoint may refer to, besides SB3's and those that
            this run uses.
        :raises CheckpointError: if the state is of another run.
        """
        own = [f"{name}[{index}]" for name, envs in self._environments.items() for index in range(len(envs))]
        if set(state.json) != {RUN, *own}:
            raise CheckpointError(
                f"The checkpoint holds {sorted(state.json)}, this run consists of {sorted([RUN, *own])}."
            )
        monitors = {}
        for name, environments in self._environments.items():
            indices = range(len(environments))
            arguments = [(_section(state, f"{name}[{index}]"), classes) for index in indices]
            monitors[name] = environments.apply_each(indices, restore_environment, arguments)
        set_networks(self._agent, state.arrays)
        rest = self._decode(_section(state, RUN), classes)
        # Files come after all that may be refused: a run that does not go on leaves them as they were.
        for name, environments in self._environments.items():
            contents = [(written,) for written in monitors[name]]
            environments.apply_each(range(len(environments)), write_monitor_files, contents)
        self._set_rest(rest)

    def _encode(self, encoder: Encoder) -> Encoded:
        parts = self._components
        capture = Capture(handler_of, {id(part): Ref(i) for i, part in enumerate(parts.values())}, len(parts))
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
            "searchers": {name: part._search_memory() for name, part in self._searching().items()},
            "files": {name: read_written(file_of(part)) for name, part in parts.items()},
            "generators": read_generators(),
        }
        data = {"attributes": attributes, "rest": encoder.encode(rest), "nodes": nodes}
        return Encoded(data, encoder.arrays)

    def _decode(self, encoded: Encoded, classes: tuple[Any, ...]) -> dict[str, Any]:
        parts, used_here = self._components, Encoder()
        self._encode(used_here)
        decoder = Decoder(encoded.arrays, {**known_names(classes), **used_here.names})
        nodes = decoder.decode_nodes(encoded.json["nodes"])
        restore = Restore(nodes, HANDLERS, list(parts.values()), "restore")
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
        for name, part in self._searching().items():
            part._go_on_searching(rest["searchers"][name])
        open_log_files(agent.logger)
        for name, written in rest["files"].items():
            write_again(file_of(self._components[name]), written)
        # Last, since whatever is made on the way may draw from them.
        set_generators(rest["generators"])

    def _searching(self) -> dict[str, Searching]:
        return {name: part for name, part in self._components.items() if isinstance(part, Searching)}


def set_networks(agent: OffPolicyAlgorithm, arrays: dict[str, np.ndarray]) -> None:
    """Give an agent the networks of a checkpoint.

    :param agent: the agent.
    :param arrays: from :meth:`RunState.capture`.
    :raises CheckpointError: if they are other networks.
    """
    tensors = {name: th.from_numpy(array) for name, array in of_section(_POLICY, arrays).items()}
    try:
        agent.policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"The networks of the checkpoint are not those of this agent: {error}"
        ) from error


def _section(state: Encoded, name: str) -> Encoded:
    return Encoded(state.json[name], of_section(name, state.arrays))


def _refusal(name: str, part: Any, error: Exception) -> str:
    path = "".join(getattr(error, "path", ()))
    reason = getattr(error, "reason", str(error))
    return (
        f"{path or type(part).__name__} (in {name}) cannot be part of a checkpoint: {reason}. Leave it out "
        "of the class's state (list its name in a class attribute not_checkpointed), or register a pair of "
        "functions for its class with sb3_mcbs.checkpoints.register_state."
    )
