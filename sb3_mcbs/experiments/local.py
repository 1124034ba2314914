"""The local engine: runs on this machine, several at a time, each in a process of its own."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.job import Job, command
from sb3_mcbs.experiments.results import FINISHED, RunFolder

#: A run that crashes is started this often in all.
ATTEMPTS = 3
#: Seconds that the processes of a runner that was killed have to end.
_GRACE = 5.0
_TICK = 0.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class LocalEngine:
    """
    Finishes runs: skips what is finished, resumes what was cut off, tries again what crashed.

    :param folders: of the runs, in the order in which they are started
    :param n_jobs: how many at a time
    :param display: what shows how far they are
    :param make_command: from a run's folder, the command that trains it
    """

    def __init__(
        self,
        folders: Sequence[RunFolder],
        n_jobs: int,
        display: Display,
        make_command: Callable[[RunFolder], list[str]] = command,
    ) -> None:
        self.jobs = [Job(folder) for folder in folders]
        self.n_jobs = n_jobs
        self.display = display
        self.make_command = make_command
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
        running = self._of_state("running")
        if self._n_heeded == 0 and n_signals == 1:
            self.display.say(
                f"Stopping: {len(running)} runs write a checkpoint after their present step. "
                "Once more to stop them at once."
            )
            for job in running:
                job.ask_to_stop()
        else:
            for job in running:
                job.kill()
        self._n_heeded = n_signals

    def _look_after(self) -> None:
        for job in self._of_state("running"):
            has_ended = job.has_ended()
            if job.look():
                self.display.evaluated(job)
            if has_ended:
                self._note_end(job)

    def _note_end(self, job: Job) -> None:
        name = job.folder.name
        if job.exit_status == 0 and job.folder.status["state"] == FINISHED:
            job.end(FINISHED)
            self.display.say(f"{name}: finished")
        elif self._n_signals:
            job.end("interrupted")
            self.display.say(f"{name}: stopped at {job.step} {job.run.unit}")
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

    def _start_some(self) -> None:
        for job in self._of_state("waiting", "taken"):
            if len(self._of_state("running")) >= self.n_jobs:
                return
            if not job.folder.lock.take():
                if job.state != "taken":
                    job.state = "taken"
                continue
            if job.folder.status["state"] == FINISHED:
                job.end(FINISHED)  # by another runner
                continue
            done = job.folder.has_begun(job.run)
            job.start(self.make_command(job.folder))
            self.display.say(f"{job.folder.name}: {'goes on' if done else 'started'}")

    def _is_done(self) -> bool:
        if self._of_state("running"):
            self._idle_since = None
            return False
        if self._n_signals:
            return True
        if not self._of_state("waiting", "taken"):
            return True
        # What is left is another runner's, or that of one that was killed a moment ago.
        self._idle_since = self._idle_since or time.monotonic()
        return time.monotonic() - self._idle_since > _GRACE
