"""Draws the scheme of one decision: ``python docs/images/scheme.py`` writes scheme.png."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

#: Height of each candidate's last state, its rewards on the way, and what the critics add.
HEIGHTS = np.array([2.6, 1.6, 0.6, -0.5, -1.5, -2.5])
REWARDS = np.array([0.9, 1.0, 1.3, 1.1, 0.8, 0.6])
CRITICS = np.array([1.3, 1.9, 1.5, 1.2, 1.4, 0.9])
STEPS, BARS = 3, 4.1
COLOUR, CHOSEN, SECOND = "#7a7a7a", "#0b3c8c", "#e0a100"


def main() -> None:
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    steps = np.arange(STEPS + 1)
    best = int((REWARDS + CRITICS).argmax())
    for index, (height, reward, value) in enumerate(zip(HEIGHTS, REWARDS, CRITICS, strict=True)):
        chosen = index == best
        colour, width = (CHOSEN, 3.5) if chosen else (COLOUR, 1.3)
        heights = height * (steps / STEPS) ** 0.7
        axes.plot(steps, heights, color=colour, linewidth=width, marker="o", markersize=3 + width)
        axes.barh(height, reward, 0.45, BARS, color=colour)
        axes.barh(height, value, 0.45, BARS + reward, color=SECOND, alpha=1 if chosen else 0.45)
    total = BARS + REWARDS[best] + CRITICS[best]
    axes.annotate("executed", (total, HEIGHTS[best]), (8, 0), textcoords="offset points", va="center")
    axes.plot(0, 0, "o", color="black", markersize=11)
    axes.annotate("state", (0, 0), (-12, 0), textcoords="offset points", ha="right", va="center")
    top = HEIGHTS[0] + 0.7
    for place, text in (
        (0.55, "1. candidates"),
        (2.2, "2. rollouts"),
        (BARS + 0.45, "3. rewards"),
        (BARS + 1.9, "4. critics"),
    ):
        axes.annotate(text, (place, top), ha="center", va="bottom")
    axes.set(xlim=(-0.7, 8), ylim=(HEIGHTS[-1] - 0.5, top + 0.9))
    axes.axis("off")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)


if __name__ == "__main__":
    main()
