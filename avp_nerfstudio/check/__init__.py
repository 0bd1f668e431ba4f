"""Checks whether a rollout's poses, intrinsics, depth and pictures belong together."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Verdict:
    """One check's outcome, in numbers and in words."""

    name: str
    """What was checked, for example `"depth agreement"`."""
    passed: bool
    """Whether every figure keeps its limit."""
    text: str
    """One line: what was measured against what limit."""
    figures: dict[str, float] = field(default_factory=dict)
    """The measured numbers; each name ends in its unit, for example `"agreeing_2cm_percent"`."""
    cause: str | None = None
    """The likely cause in words, where one is known; None for a check that passed."""
