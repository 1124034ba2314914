"""Figures that others have published."""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml


class Published(NamedTuple):
    """
    A published learning curve.

    :param name: whose
    :param steps: environment steps
    :param returns: then
    """

    name: str
    steps: np.ndarray
    returns: np.ndarray


@functools.cache
def _content() -> dict[str, Any]:
    return dict(yaml.safe_load((Path(__file__).parent / "references.yml").read_text(encoding="utf-8")))


def _base(environment: str) -> str:
    return environment.rpartition("-v")[0] or environment


def published_curves(environment: str) -> list[Published]:
    """
    :param environment: id, of any version
    :return: the curves in it
    """
    return [
        Published(name, 1000 * np.array(group["steps"]), np.array(returns[_base(environment)], dtype=float))
        for group in _content()["curves"]
        for name, returns in group["returns"].items()
        if _base(environment) in returns
    ]


def paper_finals(environment: str) -> dict[str, tuple[float, float]]:
    """
    :param environment: id, of any version
    :return: the paper's Table I: mean and standard deviation by algorithm; empty: it is not in it
    """
    return {
        name: (mean, std)
        for name, (mean, std) in _content()["paper"]["final"].get(_base(environment), {}).items()
    }


def paper_beam() -> dict[tuple[int, int], tuple[float, float]]:
    """
    :return: the paper's Table II: mean and standard deviation by beam width and depth
    """
    return {(width, depth): (mean, std) for width, depth, mean, std in _content()["paper"]["beam"]}


def sources() -> dict[str, str]:
    """
    :return: where the figures are from, by what they are
    """
    content = _content()
    return {
        "the paper's Tables I and II": content["paper"]["source"],
        **{", ".join(group["returns"]): group["source"] for group in content["curves"]},
    }
