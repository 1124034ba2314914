"""Runs on the nodes of a Ray cluster: the only module that knows Ray."""

import functools
import json
import logging
import os
import socket
import sys
import textwrap
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from sb3_mcbs.experiments.process import Lost
from sb3_mcbs.experiments.results import ResultsError, RunFolder, write
from sb3_mcbs.experiments.transfer import Packer, Parcel, unpack
from sb3_mcbs.experiments.worker import Order, Report, describe

#: Seconds that the processes of a lost node may hold their locks: as long as NFS waits for a machine.
GRACE = 120.0
#: Seconds between two looks at a run.
_LOOK_EVERY = 1.0
#: Seconds that a cluster may take to answer.
_PATIENCE = 10.0
#: The exit status of a process that was killed.
_KILLED = -9


class Node(NamedTuple):
    """
    The node that a worker got.

    :param id: Ray's
    :param name: of the machine
    :param refusal: why it may not train; nothing if it may
    :param processor: what its processor can do
    """

    id: str
    name: str
    refusal: str
    processor: str


def _make_seat() -> type:
    """
    Make the class of Ray's actors.

    Ray sends a class that is made in a function as code, so that a node which lacks this package can say so.
    """

    class Seat:
        """A place on a node for one run."""

        def admit(
            self,
            expected: dict[str, str | None],
            token: Path | None,
            scratch: Path | None,
            added_paths: list[str],
        ) -> tuple[str, ...]:
            """Say which node this is, and whether it may train."""
            import ray

            # What is checked here must be what the run's process will import.
            for path in added_paths:
                if path in sys.path:
                    sys.path.remove(path)
            node = ray.get_runtime_context().get_node_id(), socket.gethostname()
            try:
                from sb3_mcbs.experiments import worker
            except ImportError as error:
                reason = f"sb3-mcbs cannot be imported there ({error}). Install it on all nodes"
                return (*node, reason, "")
            self._worker = worker.Worker()
            # First that of nodes with another version, which may not have the second.
            reason = worker.refusal(expected, token) or worker.refusal_of_scratch(scratch)
            return (*node, reason, self._worker.processor)

        def tell(self, method: str, *arguments: Any) -> Any:
            """Call a method of the worker."""
            return getattr(self._worker, method)(*arguments)

    return Seat


class RayRun:
    """
    A run that a worker of the cluster trains, or that waits for one.

    Only what this worker answers reaches the runner's folder: one that is taken for dead, but is not, has
    nobody to answer to.

    :param cluster: where
    :param folder: of the run, whose lock is held here
    """

    def __init__(self, cluster: "Cluster", folder: RunFolder) -> None:
        self.where: str | None = None
        self._cluster = cluster
        self._folder = folder
        self._next_look = 0.0
        self._outcome: int | Lost | None = None
        self._seat: Any = None
        self._answer: Any = None
        self._on_answer: Callable[[Any], None] = self._on_admission
        self._take_place()

    def poll(self) -> int | Lost | None:
        """
        :return: the exit status, once it has ended; the run's lock is held here then, unless it was lost
        """
        import ray

        if self._outcome is None and time.monotonic() >= self._next_look:
            if self._answer is None:
                self._ask(self._on_report, "look")
            elif ray.wait([self._answer], timeout=0)[0]:
                answer, self._answer = self._answer, None
                try:
                    self._on_answer(ray.get(answer))
                except ray.exceptions.RayTaskError as error:
                    self._end(Lost(f"its worker failed: {error.cause or error}"))
                except ray.exceptions.RayError as error:
                    self._end(Lost(_first_line(error)))
        return self._outcome

    def ask_to_stop(self) -> None:
        """Let the run write a checkpoint and end, or not begin."""
        if self.where is None:
            self.kill()
        else:
            self._seat.tell.remote("stop")

    def kill(self) -> None:
        """End the run and its worker processes at once; what they did since the last report is lost."""
        self._end(_KILLED)

    def _take_place(self) -> None:
        self._seat = self._cluster.new_seat()
        cluster = self._cluster
        self._answer = self._seat.admit.remote(describe(), cluster.token, cluster.scratch, _added_paths())
        self._on_answer = self._on_admission

    def _ask(self, on_answer: Callable[[Any], None], method: str, *arguments: Any) -> None:
        self._answer, self._on_answer = self._seat.tell.remote(method, *arguments), on_answer

    def _on_admission(self, answer: tuple[str, str, str, str]) -> None:
        node = Node(*answer)
        if node.refusal:
            self._leave_place()
            self._cluster.refuse(node)
            self._take_place()
            return
        self.where = f", node {node.name} ({node.id[:8]})"
        order = self._cluster.order_for(self._folder)
        if order.scratch is None:
            self._folder.lock.give_back()  # to the worker, who holds it as long as its process may write
        self._ask(self._on_report, "begin", order)

    def _on_report(self, report: Report) -> None:
        if report.taken_by:
            self._end(Lost(f"another runner has taken it: {report.taken_by}"))
            return
        try:
            if report.progress:
                write(self._folder.progress_file, json.dumps(report.progress) + "\n")
            if report.parcel is not None:
                unpack(report.parcel, self._folder)
        except OSError as error:  # a full disk, perhaps: the others must not end with a traceback
            self._end(Lost(f"its results cannot be stored here: {error}"))
            return
        if report.status is not None:
            self._end(report.status)
        self._next_look = time.monotonic() + _LOOK_EVERY

    def _end(self, outcome: int | Lost) -> None:
        self._leave_place()
        lock = self._folder.lock
        if not isinstance(outcome, Lost) and not lock.is_held and not lock.take(_LOOK_EVERY):
            outcome = Lost(f"another runner has taken it: {lock.holder()}")
        self._outcome = outcome

    def _leave_place(self) -> None:
        import ray

        ray.kill(self._seat)


class Cluster:
    """
    A Ray cluster that this process is connected to, with what the runner asks of its nodes.

    :param say: prints a line
    :param token: a file that nodes must see; None: they need not see the runner's disk
    :param scratch: a folder of each node, in which runs are trained; None: in the runs' folders
    :param gpus_per_run: GPUs, or the share of one, for each run
    """

    def __init__(
        self, say: Callable[[str], None], token: Path | None, scratch: Path | None, gpus_per_run: float
    ) -> None:
        self.token = token
        self.scratch = scratch
        self._say = say
        self._gpus_per_run = gpus_per_run
        self._refused: dict[str, Node] = {}

    def start(self, folder: RunFolder) -> RayRun:
        """
        Train a run on a node, as soon as one has a place.

        :param folder: of the run, whose lock is held here
        :return: what trains it
        """
        return RayRun(self, folder)

    def new_seat(self) -> Any:
        """
        :return: a handle of an actor that waits for a place on a node that was not refused
        """
        import ray

        selector = {"ray.io/node-id": f"!in({','.join(self._refused)})"} if self._refused else None
        options = {"num_cpus": 1, "num_gpus": self._gpus_per_run, "max_restarts": 0}
        return ray.remote(_seat_class()).options(**options, label_selector=selector).remote()

    def refuse(self, node: Node) -> None:
        """
        Train nothing on a node.

        :param node: the node
        :raises ResultsError: if no other is left
        """
        import ray

        message = f"Node {node.name} ({node.id[:8]}) is refused: {node.refusal}."
        if node.id not in self._refused:
            self._say(message)
        self._refused[node.id] = node
        with_cpus = {each["NodeID"] for each in ray.nodes() if each["Alive"] and each["Resources"].get("CPU")}
        if with_cpus <= self._refused.keys():
            raise ResultsError(f"No node is left that may train. {message}")

    def order_for(self, folder: RunFolder) -> Order:
        """
        :param folder: of a run
        :return: what its worker gets
        """
        # Ray hides GPUs from those who ask for none, but not in every version.
        environment = {} if self._gpus_per_run else {"CUDA_VISIBLE_DEVICES": ""}
        parcel, agent_files = Parcel(), {}
        if self.scratch is not None:
            parcel, agent = Packer(folder).pack(), folder.run().agent
            if agent is not None:
                named = {"file": agent.file, "statistics": agent.statistics}
                agent_files = {name: Path(path).read_bytes() for name, path in named.items() if path}
        return Order(folder.path, self.scratch, parcel, agent_files, environment)

    def warn_of_missing(self) -> None:
        """Say so if no node has what a run needs."""
        import ray

        for needed, name in ((1, "CPU"), (self._gpus_per_run, "GPU")):
            if not any(each["Alive"] and each["Resources"].get(name, 0) >= needed for each in ray.nodes()):
                self._say(f"No node has {needed:g} {name} at present. Runs wait until one joins the cluster.")


@contextmanager
def connected(
    address: str, folder: Path, scratch: Path | None, gpus_per_run: float, say: Callable[[str], None]
) -> Iterator[Cluster]:
    """
    Connect to a cluster for as long as the context lasts.

    :param address: of the cluster; ``auto``: that of this machine
    :param folder: the experiment's results
    :param scratch: as for :class:`Cluster`
    :param gpus_per_run: as for :class:`Cluster`
    :param say: as for :class:`Cluster`
    :raises ResultsError: if Ray is not installed, or no cluster answers
    """
    try:
        import ray
    except ImportError as error:
        raise ResultsError("--engine ray needs Ray: pip install 'sb3-mcbs[ray]'.") from error
    try:
        _reach(address)
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        raise ResultsError(
            f"No Ray cluster answers at {address}: {_first_line(error).rstrip('.')}. Start one with "
            "'ray start --head', and on each other machine 'ray start --address=HEAD:6379'."
        ) from error
    token = None if scratch is not None else folder.absolute() / f".seen-by-nodes-{uuid.uuid4().hex}"
    try:
        if token is not None:
            token.touch()
        cluster = Cluster(say, token, scratch, gpus_per_run)
        cluster.warn_of_missing()
        yield cluster
    finally:
        if token is not None:
            token.unlink(missing_ok=True)
        ray.shutdown()


def _reach(address: str) -> None:
    """See whether somebody listens at an address: Ray would try for many minutes."""
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS", address)
    host, colon, port = address.rpartition(":")
    if colon and "/" not in host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_PATIENCE).close()


def _added_paths() -> list[str]:
    """What Ray puts before the other paths that its workers import from: folders of this process."""
    script_folder = os.path.dirname(os.path.realpath(sys.argv[0]))
    return [os.getcwd(), *([script_folder] if script_folder in sys.path else [])]


@functools.cache
def _seat_class() -> type:
    return _make_seat()


def _first_line(error: BaseException) -> str:
    return textwrap.shorten(next(iter(str(error).splitlines()), type(error).__name__), 200)
