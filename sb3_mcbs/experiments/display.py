"""What a runner shows: a live table in a terminal, lines elsewhere."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_mcbs.experiments.job import Job
from sb3_mcbs.experiments.results import FINISHED

_STYLES = {"running": "bold", FINISHED: "green", "failed": "red", "interrupted": "yellow", "waiting": "dim"}


class Display:
    """
    Shows how far the runs of an experiment are.

    :param console: where; None: the standard output
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False, soft_wrap=True)
        self._live: Live | None = None
        self._jobs: Sequence[Job] = ()

    @contextmanager
    def of(self, jobs: Sequence[Job]) -> Iterator[None]:
        """
        Show runs as long as the context lasts.

        :param jobs: the runs
        """
        self._jobs = jobs
        n_finished = sum(job.state == FINISHED for job in jobs)
        self.say(f"{len(jobs)} runs, {n_finished} of them finished before")
        if not self.console.is_terminal:
            yield
            return
        with Live(console=self.console, auto_refresh=False) as self._live:
            yield
            self.refresh()  # what stays on the screen
        self._live = None

    def refresh(self) -> None:
        """Draw the table again."""
        if self._live is not None:
            self._live.update(self._table(), refresh=True)

    def say(self, text: str) -> None:
        """
        :param text: printed above the table
        """
        self.console.print(f"{time.strftime('%H:%M:%S')} {text}", markup=False)

    def evaluated(self, job: Job) -> None:
        """
        :param job: a run that was evaluated just now
        """
        episode_of_many = job.run.agent is not None and job.step < job.run.steps
        if self._live is None and not episode_of_many:
            speed, left = _number(job.steps_per_second), _duration(job.seconds_left)
            self.say(
                f"{job.folder.name}: {job.step} of {job.run.steps} {job.run.unit}, {_returns(job)}"
                f"{f', {speed} {job.run.unit}/s' if speed else ''}{f', {left} left' if left else ''}"
            )

    def summary(self, jobs: Sequence[Job]) -> None:
        """
        Print what became of the runs.

        :param jobs: the runs
        """
        by_state: dict[str, list[Job]] = {}
        for job in jobs:
            by_state.setdefault(job.state, []).append(job)
        self.say(", ".join(f"{len(of_state)} {state}" for state, of_state in by_state.items()))
        for job in by_state.get("failed", []):
            self.say(f"{job.folder.name}: failed, see {job.folder.log}. The same command tries again.")
        for job in by_state.get("taken", []):
            self.say(f"{job.folder.name}: left to process {job.folder.lock.holder()}, which trains it")

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        table.add_column("run", no_wrap=True)
        for name in ("state", "done", "per s", "last returns", "left"):
            table.add_column(name, justify="left" if name == "state" else "right", no_wrap=True)
        shown = self._shown()
        for job in shown:
            row = (f"{job.step} / {job.run.steps}", _number(job.steps_per_second), _returns(job),
                   _duration(job.seconds_left))  # fmt: skip
            table.add_row(job.folder.name, job.state, *row, style=_STYLES.get(job.state, ""))
        if len(shown) < len(self._jobs):
            table.add_row(f"and {len(self._jobs) - len(shown)} more", style="dim")
        return table

    def _shown(self) -> Sequence[Job]:
        """As many runs as the terminal has lines for; those that run come first."""
        room = max(5, self.console.size.height - 4)
        if len(self._jobs) <= room:
            return self._jobs
        return sorted(self._jobs, key=lambda job: job.state != "running")[:room]


def _returns(job: Job) -> str:
    return ", ".join(f"{label} {value:.1f}" for label, value in job.returns.items())


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
    )
