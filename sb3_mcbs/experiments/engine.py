"""The engine: finishes runs, several at a time, each in a process of its own, here or on other nodes."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.job import Job
from sb3_mcbs.experiments.process import Trainer, start_process
from sb3_mcbs.experiments.results import FINISHED, RunFolder

#: A run that crashes is started this often in all.
ATTEMPTS = 3
#: A run whose node is lost this often in a row, without a new checkpoint, is given up.
LOSSES = 10
#: Seconds that the processes of a runner that was killed, or of a lost node, have to end.
GRACE = 5.0
_TICK = 0.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


#: States of a run that a trainer has.
_STARTED = ("queued", "running")


class Engine:
    """
    Finishes runs: skips what is finished, resumes what was cut off, tries again what crashed.

    :param folders: of the runs, in the order in which they are started
    :param n_jobs: how many at a time; None: as many as get a place
    :param display: what shows how far they are
    :param launch: from a run's folder, what trains it; by default a process of this machine
    :param grace: seconds that the processes of a runner that was killed have to end
    """

    def __init__(
        self,
        folders: Sequence[RunFolder],
        n_jobs: int | None,
        display: Display,
        launch: Callable[[RunFolder], Trainer] = start_process,
        grace: float = GRACE,
    ) -> None:
        self.jobs = [Job(folder) for folder in folders]
        self.n_jobs = n_jobs
        self.display = display
        self.launch = launch
        self.grace = grace
        self._n_signals = 0
        self._n_heeded = 0
        self._idle_since: float | None = None

    def finish(self) -> int:
        """
        Work until there is nothing left to do.

        :return: the exit status: 0 if all runs are finished, 130 if a signal ended it, 1 otherwise
        """
        with self._signals(), self.display.of(self.jobs):
            while True:
                self._heed_signals()
                self._look_after()
                if not self._n_signals:
                    self._start_some()
                if self._is_done():
                    break
                self.display.refresh()
                time.sleep(_TICK)
        self.display.summary(self.jobs)
        if self._n_signals:
            return 130
        return 0 if all(job.state == FINISHED for job in self.jobs) else 1

    def _of_state(self, *states: str) -> list[Job]:
        return [job for job in self.jobs if job.state in states]

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(signum: int, frame: FrameType | None) -> None:
            self._n_signals += 1

        previous = {signum: signal.signal(signum, note) for signum in _SIGNALS}
        try:
            yield
        finally:
            for signum, handler in previous.items():
                signal.signal(signum, handler)

    def _heed_signals(self) -> None:
        n_signals = self._n_signals  # read once: another one may come while this one is heeded
        if n_signals == self._n_heeded:
            return
        started = self._of_state(*_STARTED)
        if self._n_heeded == 0 and n_signals == 1:
            n_running = len(self._of_state("running"))
            self.display.say(
                f"Stopping: {n_running} runs write a checkpoint after their present step. "
                "Once more to stop them at once."
            )
            for job in started:
                job.ask_to_stop()
        else:
            for job in started:
                job.kill()
        self._n_heeded = n_signals

    def _look_after(self) -> None:
        for job in self._of_state(*_STARTED):
            self._announce(job)
            has_ended = job.has_ended()
            if job.look():
                self.display.evaluated(job)
            if has_ended:
                self._note_end(job)

    def _announce(self, job: Job) -> None:
        if job.state == "queued" and job.where is not None:
            job.state = "running"
            self.display.say(f"{job.folder.name}: {'goes on' if job.goes_on else 'started'}{job.where}")

    def _note_end(self, job: Job) -> None:
        name = job.folder.name
        if job.exit_status == 0 and job.folder.status["state"] == FINISHED:
            job.end(FINISHED)
            self.display.say(f"{name}: finished")
        elif self._n_signals:
            job.end("interrupted")
            self.display.say(f"{name}: stopped at {job.step} {job.run.unit}")
        elif job.lost is not None:
            self._note_loss(job, job.lost.reason)
        else:
            job.crashes += 1
            again = job.crashes < ATTEMPTS
            log = "\n".join(f"    {line}" for line in job.folder.log_tail())
            self.display.say(
                f"{name}: ended with status {job.exit_status}, "
                f"{'trying again' if again else 'given up'} after attempt {job.crashes} of {ATTEMPTS}. "
                f"The end of {job.folder.log}:\n{log}"
            )
            job.end("waiting" if again else "failed")

    def _note_loss(self, job: Job, reason: str) -> None:
        job.note_loss()
        again = job.losses < LOSSES
        outlook = "goes on elsewhere" if again else f"given up after {LOSSES} times without a new checkpoint"
        self.display.say(f"{job.folder.name}: lost at {job.step} {job.run.unit}, {outlook}: {reason}")
        job.end("waiting" if again else "failed")

    def _start_some(self) -> None:
        for job in self._of_state("waiting", "taken"):
            if self.n_jobs is not None and len(self._of_state(*_STARTED)) >= self.n_jobs:
                return
            if not job.folder.lock.take():
                if job.state != "taken":
                    job.state = "taken"
                continue
            if job.folder.status["state"] == FINISHED:
                job.end(FINISHED)  # by another runner
                continue
            job.start(self.launch)
            self._announce(job)

    def _is_done(self) -> bool:
        if self._of_state(*_STARTED):
            self._idle_since = None
            return False
        if self._n_signals:
            return True
        if not self._of_state("waiting", "taken"):
            return True
        # What is left is another runner's, or that of one that was killed a moment ago.
        self._idle_since = self._idle_since or time.monotonic()
        return time.monotonic() - self._idle_since > self.grace
