"""Ranges of numbers that a flag takes."""

from __future__ import annotations

import math
from typing import Any

import click


class Within(click.FloatRange):
    """A range of numbers: what is no number at all is outside of it, which comparisons with the bounds do not tell."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, if it is one and within the range."""
        found = super().convert(value, param, ctx)
        if math.isnan(found):
            self.fail(f"{value} is not in the range {self._describe_range()}.", param, ctx)
        return found
