"""The characteristics of a study: quantities of the vehicle, and the parameters of the scenario
that the study searches. Their domains, the filter of small changes, and measures of change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from numbers import Real
from typing import Any

import numpy as np
from msgspec.structs import asdict, force_setattr

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.records import BoolArray, FloatArray, NamedValues, Quantity
from safevar_sumo.study import (
    PHASE,
    PHASE_DECIMALS,
    CharacteristicTable,
    Interval,
    Study,
    plain_values,
    unit_text,
)

PLAUSIBLE_MULTIPLE = 1000.0
"""Values beyond this multiple of the domain's largest magnitude count as typos."""
DIGIT_ROUNDING = 1e-6
"""Difference from a rounded value, in units of its last digit, that counts as a rounding error."""
FILTER_SHARES = ((1000.0, 0.01), (100.0, 0.02), (1.0, 0.04), (0.0, 0.08))
"""Pairs of a width and a share beta. The first pair whose width a domain reaches gives its beta:
the filter keeps changes that are larger than this share of the domain's width (method section 2).
"""


class Characteristic(CharacteristicTable, frozen=True, kw_only=True):
    """One characteristic of the vehicle under test, or a searched parameter of the scenario
    (`is_scenario`), with the fields of its table in the study. All values are in `unit`.

    `short_name` is the name in sentences: by default the meaning up to the first comma or bracket,
    such as `engine drag`, or `name` if the study gives no meaning.
    """

    name: str
    is_scenario: bool = False

    def __post_init__(self) -> None:
        if not self.short_name:
            beginning = re.split(r"[,;(]", self.meaning)[0].strip()
            force_setattr(self, "short_name", beginning or self.name)

    @property
    def words(self) -> str:
        """Meaning and real-world counterpart in one line; empty if the study gives neither."""
        counterpart = ""
        if self.counterpart:
            counterpart = f"counterpart: {self.counterpart}"
        return "; ".join(text for text in (self.meaning, counterpart) if text)

    @property
    def is_for_workshop(self) -> bool:
        """Whether a workshop can measure this characteristic, and the study says how."""
        return self.workshop and bool(self.measurement)

    def is_decidable(self, low: float, high: float) -> bool:
        """Whether a measurement can decide that a value is within the limits `low` and `high`: the
        original value, measured with the largest error, is still within them. True without a stated
        precision, and if both limits are equal.
        """
        if self.precision is None or low == high:
            return True
        nearest_low, nearest_high = self.measured(self.original)
        return low <= nearest_low and high >= nearest_high

    @property
    def error(self) -> float:
        """Largest difference of a measured value from the true value; 0 without a precision."""
        if self.precision is None:
            return 0.0
        return self.precision.value

    def measured(self, value: float) -> Interval:
        """The least and the greatest true value of a measured value, within the domain."""
        ends = np.round([value - self.error, value + self.error], 12)
        low, high = np.clip(ends, self.lower, self.upper).tolist()
        return low, high

    @property
    def threshold(self) -> float:
        """Largest change that the filter removes: Th = beta (u - l) (method section 2). The
        threshold of a scenario parameter is 0, because each of its values is another encounter.
        """
        if self.is_scenario:
            return 0.0
        return self.resolution

    @property
    def resolution(self) -> float:
        """A change too small to matter: beta (u - l) (method section 2), also for a parameter of
        the scenario.
        """
        width = self.upper - self.lower
        shares = (
            share for smallest_width, share in FILTER_SHARES if width >= smallest_width
        )
        return next(shares) * width

    @property
    def largest_plausible(self) -> float:
        """Largest plausible magnitude of a value beyond the domain."""
        return PLAUSIBLE_MULTIPLE * max(abs(self.lower), abs(self.upper))

    def text(self, value: float) -> str:
        """A value as text, rounded so that one unit of its last digit is at most a quarter of
        `resolution`.
        """
        return f"{value:.{self.digits}f}"

    @property
    def digits(self) -> int:
        """Number of decimals of `text`."""
        if self.is_scenario and self.name == PHASE:
            return PHASE_DECIMALS
        return max(0, math.ceil(-math.log10(self.resolution / 4)))

    def rounded(self, value: float, *, upwards: bool) -> float:
        """A limit rounded to the digits of `text`, upwards or downwards. If rounding would carry
        the limit past the original value, the original value is returned.
        """
        scale = 10**self.digits
        if upwards:
            rounded = math.ceil(value * scale - DIGIT_ROUNDING) / scale
            is_beyond = rounded > self.original >= value
        else:
            rounded = math.floor(value * scale + DIGIT_ROUNDING) / scale
            is_beyond = rounded < self.original <= value
        return self.original if is_beyond else rounded

    def rounded_inwards(self, interval: Interval) -> Interval:
        """An interval around the original value, with both ends rounded towards this value. An end
        of the domain stays as it is.
        """
        low, high = interval
        if low > self.lower:
            low = self.rounded(low, upwards=True)
        if high < self.upper:
            high = self.rounded(high, upwards=False)
        return low, high

    @property
    def suffix(self) -> str:
        """The unit as text after a number; empty without a unit."""
        return unit_text(self.unit)

    def check(
        self,
        value: float,
        *,
        beyond: bool = False,
        otherwise: str = "",
        switch: str = "beyond=True",
    ) -> None:
        """Refuse a value that is no number, or is not legal (see `is_legal`).

        `otherwise` describes further legal values for the message. `switch` is the option that
        allows values beyond the domain; "" if there is no such option.

        Raises
        ------
        InputError
            The error names the value and what is expected.
        """
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if is_number and self.is_legal(value, beyond=beyond):
            return
        problem = f"{self.name} = {value!r}"
        expected = f"a number in [{self.lower:g}, {self.upper:g}]"
        hint = ""
        if beyond:
            sign = " from 0" if self.is_scenario else ""
            if self.lower > 0:
                sign = " above 0"
            expected = f"a finite number{sign}, up to {self.largest_plausible:g}"
        # The option `switch` would allow this value: the message says so.
        elif is_number and self.is_legal(value, beyond=True):
            problem += " is outside its domain"
            if switch:
                hint = f", or any with {switch}"
        raise InputError("", problem, f"{expected}{self.suffix}{otherwise}{hint}")

    def is_legal(self, values: Quantity, *, beyond: bool) -> Quantity:
        """Whether values, a number or an array, are in the domain. With `beyond`, whether they are
        plausible.

        The magnitude of a plausible value is at most 1000 times the largest magnitude in the
        domain. A plausible value is above 0 if the whole domain is, and a plausible value of a
        scenario parameter is never below 0.
        """
        if beyond:
            is_positive = (values > 0) | (self.lower <= 0) & (
                (values >= 0) | (not self.is_scenario)
            )
            return (np.abs(values) <= self.largest_plausible) & is_positive
        return (values >= self.lower) & (values <= self.upper)


@dataclass(frozen=True)
class CharacteristicSet:
    """The n characteristics C_1..C_n of a study: first the characteristics of the vehicle, then the
    searched parameters of the scenario. N settings are an array of shape (N, n).
    """

    members: tuple[Characteristic, ...]

    @classmethod
    def of(cls, study: Study) -> CharacteristicSet:
        """The characteristics of a study, in its order."""
        return cls(
            tuple(
                Characteristic(
                    name=name,
                    is_scenario=name in study.ranges,
                    **asdict(row),
                )
                for name, row in study.domains.items()
            )
        )

    def __len__(self) -> int:
        return len(self.members)

    def options(self, setting: FloatArray) -> str:
        """The options of the command `simulate` that state a setting, shape (n,)."""
        changes = self._changes_of(setting)
        words = [f"--set {name}={value!r}" for name, value in changes.items()]
        if ((setting < self.lower) | (setting > self.upper)).any():
            words.append("--beyond")
        return " ".join(words)

    def __iter__(self) -> Iterator[Characteristic]:
        return iter(self.members)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(characteristic.name for characteristic in self.members)

    @cached_property
    def vehicle(self) -> CharacteristicSet:
        """The characteristics of the vehicle alone."""
        return CharacteristicSet(tuple(compress(self.members, self.of_vehicle)))

    @cached_property
    def scenario(self) -> CharacteristicSet:
        """The searched parameters of the scenario; empty in most studies."""
        return CharacteristicSet(tuple(compress(self.members, ~self.of_vehicle)))

    @cached_property
    def of_vehicle(self) -> BoolArray:
        """Whether each member is a characteristic of the vehicle, shape (n,)."""
        return np.array([not member.is_scenario for member in self.members], bool)

    def of_others(
        self, characteristics: CharacteristicSet, settings: FloatArray
    ) -> FloatArray:
        """The columns of this set, shape (N, n), in settings of a larger set of `characteristics`,
        shape (N, m).
        """
        return settings[:, [characteristics.names.index(name) for name in self.names]]

    def with_original_vehicle(self, settings: FloatArray) -> FloatArray:
        """The settings of the original vehicle in the encounters of `settings`; both have the shape
        (N, n).
        """
        return np.where(self.of_vehicle, self.original, settings)

    def with_printed_encounters(self, settings: FloatArray) -> FloatArray:
        """Settings, shape (N, n), with scenario parameters rounded to the decimals that are
        printed: then a printed encounter is the simulated one.
        """
        rounded = settings.copy()
        for column in np.flatnonzero(~self.of_vehicle):
            item = self.members[column]
            values = np.round(settings[:, column], item.digits)
            rounded[:, column] = np.clip(values, item.lower, item.upper)
        return rounded

    @cached_property
    def original(self) -> FloatArray:
        return self._column("original")

    @property
    def original_settings(self) -> FloatArray:
        """The original setting as an array of one setting, shape (1, n)."""
        return self.original[np.newaxis]

    @cached_property
    def lower(self) -> FloatArray:
        return self._column("lower")

    @cached_property
    def upper(self) -> FloatArray:
        return self._column("upper")

    @cached_property
    def threshold(self) -> FloatArray:
        return self._column("threshold")

    def _column(self, attribute: str) -> FloatArray:
        """One attribute of all characteristics as a read-only array, shape (n,)."""
        values = np.array(
            [getattr(member, attribute) for member in self.members], float
        )
        values.flags.writeable = False
        return values

    def named(self, setting: FloatArray) -> NamedValues:
        """The values of a setting, shape (n,), by name."""
        return dict(zip(self.names, setting.tolist(), strict=True))

    def _changes_of(self, setting: FloatArray) -> NamedValues:
        pairs = zip(self.members, setting.tolist(), strict=True)
        return {item.name: value for item, value in pairs if value != item.original}

    def changes_in_words(self, setting: FloatArray) -> str:
        """The changed values of a setting, shape (n,); "" if none is changed."""
        changes = self._changes_of(setting)
        return ", ".join(f"{name} = {value:g}" for name, value in changes.items())

    def encounter_of(self, setting: FloatArray) -> NamedValues:
        """The values of the scenario parameters of a setting, shape (n,), by name."""
        return self.scenario.named(setting[~self.of_vehicle])

    def columns(self, settings: FloatArray) -> dict[str, FloatArray]:
        """The columns of N settings, shape (N, n), by characteristic; a column has shape (N,)."""
        return dict(zip(self.names, np.ascontiguousarray(settings.T), strict=True))

    def filter(self, settings: FloatArray) -> FloatArray:
        """Reset each value that differs from the original by no more than the threshold (method
        section 2).
        """
        return np.where(
            np.abs(self.original - settings) > self.threshold, settings, self.original
        )

    def changed(self, filtered: FloatArray) -> BoolArray:
        """Whether each value of filtered settings differs from the original, shape (N, n)."""
        return np.asarray(filtered != self.original)

    def change_objectives(self, settings: FloatArray) -> dict[str, Any]:
        """The objectives `f_diff` and `f_num_diff` of settings, after the filter."""
        filtered = self.filter(settings)
        return {
            "f_diff": self.largest_change(filtered),
            "f_num_diff": self.number_changed(filtered),
        }

    def largest_change(self, filtered: FloatArray) -> FloatArray:
        """f_diff = max_i |v_i - v''_i| / |v_i| over the vehicle's characteristics, shape (N,), with
        the original values v and the filtered values v'' (method section 3). If an original value
        is 0, the width of the domain replaces |v_i|.
        """
        vehicle = self.vehicle
        scale = np.where(
            vehicle.original == 0,
            vehicle.upper - vehicle.lower,
            np.abs(vehicle.original),
        )
        changes = np.abs(vehicle.original - filtered[:, self.of_vehicle]) / scale
        return np.asarray(np.max(changes, axis=1))

    def number_changed(self, filtered: FloatArray) -> FloatArray:
        """f_numDiff, the number of changed characteristics of the vehicle, shape (N,) (method
        section 3).
        """
        return np.asarray(
            np.count_nonzero(self.changed(filtered) & self.of_vehicle, axis=1),
            float,
        )

    def setting(
        self, values: Mapping[str, float], *, beyond: bool = False
    ) -> FloatArray:
        """The original setting with some values replaced, shape (n,). With `beyond`, plausible
        values outside the domain are legal, too.

        Raises
        ------
        InputError
            If a name is unknown, or a value is outside its domain (with `beyond`, not plausible).
        """
        values = plain_values(values)
        if not isinstance(values, Mapping):
            raise InputError(
                "",
                f"is a {type(values).__name__}",
                "values by characteristic, such as {'mass': 2500}",
            )

        setting = self.original.copy()
        for name, value in values.items():
            check_name("", f"there is no characteristic {name!r}", name, self.names)
            column = self.names.index(name)
            self.members[column].check(value, beyond=beyond)
            setting[column] = value
        return setting
