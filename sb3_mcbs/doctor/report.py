"""The doctor's verdict, and its report in words."""

import math
import statistics
import textwrap
from collections.abc import Iterator
from typing import Any

from sb3_mcbs.doctor.recipe import recipe

#: Exit statuses.
EXACT_AND_FAST, SLOW, DOES_NOT_WORK = 0, 1, 2
#: A decision of the preset "efficient" that takes no more milliseconds is fast, whatever simulates it.
FAST = 20.0
#: The same for training with it.
AFFORDABLE = 100.0
#: The verdict where look-ahead could not be tried.
_WITHOUT = {
    "making the environment": "The environment cannot be made.",
    "loading the agent": "The agent cannot be used.",
}
_WIDTH = 80
_LABEL = 15


def verdict(findings: dict[str, Any]) -> int:
    """
    :param findings: of an examination
    :return: the exit status
    """
    if "problem" in findings:
        return DOES_NOT_WORK
    if findings["forward_model"]["kind"] == "mujoco":
        return EXACT_AND_FAST
    return EXACT_AND_FAST if milliseconds(findings) <= FAST else SLOW


def milliseconds(findings: dict[str, Any]) -> float:
    """
    :param findings: of an examination
    :return: of a decision with the preset "efficient"
    """
    times = [cost.get("milliseconds") for cost in findings["costs"] if cost["preset"] == "efficient"]
    return times[0] if times and times[0] is not None else math.inf


def block(findings: dict[str, Any], name: str, wrappers: list[str]) -> str | None:
    """
    :param findings: of an examination
    :param name: of the environment
    :param wrappers: of the environment
    :return: an entry of a hyperparameter file; None if no agent of this package can be trained
    """
    if "problem" not in findings:
        affordable = not findings["snapshot"]["replays"] and milliseconds(findings) <= AFFORDABLE
        return recipe(findings, name, wrappers, exact=True, simulate=affordable)
    if findings["stage"] == "taking snapshots" and "steps_per_second" in findings:
        return recipe(findings, name, wrappers, exact=False, simulate=False)
    return None


def lines(findings: dict[str, Any], name: str, block_text: str | None) -> Iterator[str]:
    """
    :param findings: of an examination
    :param name: of the environment
    :param block_text: from :func:`block`
    :return: the report, in lines of at most 80 characters where nothing forbids it
    """
    if "environment" in findings:
        yield from _environment(findings, name)
    if "snapshot" in findings:
        yield from _snapshot(findings["snapshot"])
    if "forward_model" in findings:
        yield from _forward_model(findings["forward_model"])
    if "agent" in findings:
        yield from _agent(findings["agent"])
    if findings["costs"]:
        yield from _costs(findings)
    if findings["episodes"]:
        yield from _episodes(findings)
    yield ""
    yield from _verdict(findings)
    if block_text is not None:
        how = "To train with RL Zoo, save this as doctor.yml:"
        if "problem" in findings:
            how = "Without simulating, the critics can rank the candidates. For RL Zoo, as doctor.yml:"
        yield from ["", how, "", block_text]


def _entry(label: str, *texts: str) -> Iterator[str]:
    """A label, and paragraphs beside it."""
    for text in texts:
        yield from textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"{label:{_LABEL}}",
            subsequent_indent=" " * _LABEL,
            break_on_hyphens=False,
            break_long_words=False,
        )
        label = ""


def _environment(findings: dict[str, Any], name: str) -> Iterator[str]:
    about = findings["environment"]
    yield from _entry("Environment", f"{name} ({about['class']})")
    yield from _entry("", f"observations: {about['observations']}; actions: {about['actions']}")
    if "steps_per_second" in findings:
        period = about["control_period"]
        says = "no control period is known" if period is None else f"control period {1000 * period:.3g} ms"
        yield from _entry("", f"{findings['steps_per_second']:,.0f} steps/s by itself; {says}")


def _snapshot(found: dict[str, Any]) -> Iterator[str]:
    by = " and ".join(found["captured_by"]) or "no adapter: all state is in Python's attributes"
    yield from _entry(
        "Snapshots",
        f"exact: {found['steps_compared']} steps compared, bit by bit",
        f"captured by {by}" if found["captured_by"] else by,
        f"{_bytes(found['bytes'])}, {found['milliseconds']:.2g} ms to take and restore one",
    )


def _bytes(n: int) -> str:
    return f"{n / 1e6:.1f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB"


def _forward_model(found: dict[str, Any]) -> Iterator[str]:
    reason = found["why_not_faster"]
    yield from _entry("Forward model", found["description"])
    if reason:
        yield from _entry("", f"The faster MuJoCo batch cannot simulate it: {reason}.")
    says = "deterministic" if found["deterministic"] else "random: every simulation draws its own numbers"
    yield from _entry("Dynamics", says)


def _agent(found: dict[str, Any]) -> Iterator[str]:
    yield from _entry("Agent", f"{found['algorithm']} from {found['file']}")
    if found["statistics"] is not None:
        yield from _entry("", f"observations normalized with {found['statistics']}")


def _costs(findings: dict[str, Any]) -> Iterator[str]:
    period = findings["environment"]["control_period"]
    who = findings["agent"]["algorithm"] if "agent" in findings else "untrained TD3, layers of 400 and 300"
    yield from ["", f"Cost of a decision on this machine ({who})"]
    of_period = "" if period is None else "of control period"
    yield f"  {'preset':12} {'simulated steps':>15} {'ms':>9} {'steps/s':>9} {of_period:>18}".rstrip()
    reason = None
    for cost in findings["costs"]:
        start = f"  {cost['preset']:12} "
        if "unsuitable" in cost:
            text = "not here either" if cost["unsuitable"] == reason else f"not here: {cost['unsuitable']}"
            reason = cost["unsuitable"]
            yield from textwrap.wrap(start + text, _WIDTH, subsequent_indent=" " * _LABEL)
        elif "too_slow" in cost:
            yield f"{start}not measured: about {cost['too_slow']:,.0f} s per decision"
        else:
            share = "" if period is None else f"{cost['milliseconds'] / 1000 / period:,.0%}"
            numbers = f"{_short(cost['milliseconds']):>9} {_short(cost['steps_per_second']):>9}"
            yield f"{start}{cost['simulated_steps']:15,.0f} {numbers} {share:>18}".rstrip()


def _short(number: float) -> str:
    return f"{number:,.1f}" if number < 100 else f"{number:,.0f}"


def _episodes(findings: dict[str, Any]) -> Iterator[str]:
    n = len(findings["episodes"][0]["episodes"])
    seeds = f"{n} episodes, reset seeds 0 to {n - 1}" if n > 1 else "one episode, reset seed 0"
    yield from ["", f"Return ({seeds})"]
    yield f"  {'policy':12} {'return':>15} {'simulated steps':>17}"
    for policy in findings["episodes"]:
        mean = statistics.mean(episode["total"] for episode in policy["episodes"])
        simulated = sum(episode["simulated_steps"] for episode in policy["episodes"])
        yield f"  {policy['policy']:12} {mean:15.1f} {simulated:17,}"
    for skipped in findings["not_played"]:
        seconds = f"{skipped['seconds']:,.0f} s"
        yield f"  {skipped['preset']:12} not played, as it takes about {seconds}: see sb3-mcbs evaluate"


def _verdict(findings: dict[str, Any]) -> Iterator[str]:
    status = verdict(findings)
    if status == EXACT_AND_FAST:
        yield from _entry("Verdict", "Look-ahead works: exact and fast.")
    elif status == SLOW:
        yield from _entry("Verdict", "Look-ahead is exact, but slow.", _how_to_be_faster(findings))
    else:
        yield from _entry("Verdict", _WITHOUT.get(findings["stage"], "Look-ahead does not work."))
        yield from _entry("Problem", findings["problem"])
        if "advice" in findings:
            yield from _entry("Advice", findings["advice"])


def _how_to_be_faster(findings: dict[str, Any]) -> str:
    if findings["snapshot"]["replays"]:
        learn = ", or learn a model (forward_model: ensemble)"
        return (
            "A restore repeats the episode, so decisions take the longer the later they are: let the critics "
            "alone rank the candidates (rollout_depth: 0), as below"
            f"{learn if findings['environment']['policy'] == 'MlpPolicy' else ''}."
        )
    return (
        "Simulating takes as long as the environment's own steps: make those faster, or if it simulates with "
        "MuJoCo, give it a family (docs/fast_path.md)."
    )
