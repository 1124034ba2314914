"""Examines an environment in a process of its own, and says what became of that."""

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable
from typing import IO, Any

from sb3_mcbs.doctor.child import Request

#: Where a line of ``faulthandler`` begins.
_FRAME = re.compile(r'File "(.+)", line (\d+) in (\S+)')
#: Seconds between two looks at whether the process lives.
_LOOK = 0.2
#: Findings of which there may be several, and where they are collected.
_LISTS = {"cost": "costs", "episodes": "episodes", "not_played": "not_played"}
#: Seconds that Python and this package may take to start.
_START = 120.0
#: Lines of the process's output that are shown if it crashes.
_LINES = 3


def examine(request: Request, limit: float, on_stage: Callable[[str], None]) -> dict[str, Any]:
    """
    Examine an environment, whatever it does.

    :param request: what to examine
    :param limit: seconds that one stage may take; the episodes of one policy are such a stage
    :param on_stage: told of each stage that begins
    :return: the findings by name; lists of ``costs`` and ``episodes``; if something is wrong ``problem``,
        ``stage`` and perhaps ``advice``
    """
    reading, writing = os.pipe()
    command = [sys.executable, "-X", "faulthandler", "-m", "sb3_mcbs.doctor.child"]
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        process = subprocess.Popen(
            [*command, json.dumps(request._asdict()), str(writing)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=[writing],
            start_new_session=True,
        )
        os.close(writing)
        try:
            findings = Findings(on_stage)
            in_time = _follow(process, reading, findings, limit)
            if not findings.ended:
                _note_end(process, output, findings.found, None if in_time else limit)
        finally:
            _end(process)
            os.close(reading)
    return findings.found


class Findings:
    """
    What the process has told so far.

    :param on_stage: told of each stage that begins
    """

    def __init__(self, on_stage: Callable[[str], None]) -> None:
        self.found: dict[str, Any] = {"stage": "starting Python"}
        self.found |= {name: [] for name in _LISTS.values()}
        self.begun = self.ended = False
        self._on_stage = on_stage

    def add(self, message: dict[str, Any]) -> None:
        """
        :param message: of the process
        """
        found = self.found
        if "end" in message:
            self.ended = True
        elif "stage" in message:
            self.begun = True
            found["stage"] = message["stage"]
            self._on_stage(message["stage"])
        elif "problem" in message:
            found |= message
        else:
            name, value = message["finding"], message["value"]
            if name in _LISTS:
                found[_LISTS[name]].append(value)
            else:
                found[name] = value


def _follow(process: subprocess.Popen[bytes], pipe: int, findings: Findings, limit: float) -> bool:
    """Take in what the process says until it ends. Return whether each stage ended in time."""
    heard, rest = time.monotonic(), b""
    while not findings.ended:
        lives = process.poll() is None
        if select.select([pipe], [], [], _LOOK)[0]:
            data = os.read(pipe, 2**16)
            if not data:  # nobody can write any more
                return _ends(process, limit)
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                findings.add(json.loads(line))
                heard = time.monotonic()
        elif not lives:  # what it has started may keep the pipe open
            return True
        if time.monotonic() - heard > (limit if findings.begun else max(limit, _START)):
            return False
    return True


def _ends(process: subprocess.Popen[bytes], limit: float) -> bool:
    try:
        process.wait(limit)
    except subprocess.TimeoutExpired:
        return False
    return True


def _note_end(
    process: subprocess.Popen[bytes], output: IO[str], found: dict[str, Any], limit: float | None
) -> None:
    """Say how a process ended that did not come to its end, and where it was.

    :param limit: that it exceeded; None: it ended by itself.
    """
    if limit is not None:
        process.send_signal(signal.SIGABRT)  # faulthandler writes where it hangs
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(2)
    status = process.poll()
    output.seek(0)
    text = output.read()
    where = _place(text.partition("most recent call first")[2])
    found["problem"] = f"While {found['stage']}, "
    if limit is not None:
        found["problem"] += f"the process did not come back within {limit:g} seconds.{where}"
        found["advice"] = "If it only is slow, give it more time with --time-limit."
    elif status is not None and status < 0:
        found["problem"] += f"the process crashed with {signal.Signals(-status).name}.{where}"
    else:
        found["problem"] += f"the process ended with exit status {status}."
        last = [line for line in text.splitlines() if line.strip()][-_LINES:]
        if last:
            found["problem"] += " Its last output: " + " ".join(last)


def _place(trace: str) -> str:
    """Say where a process was, if faulthandler wrote it: in which function that is not Python's own."""
    frames = _FRAME.findall(trace)
    others = [frame for frame in frames if not frame[0].startswith(("<", sysconfig.get_path("stdlib")))]
    if not frames:
        return ""
    file, line, function = (others or frames)[0]
    return f" It was in {function} ({os.path.relpath(file)}, line {line})."


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the process, and what it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
