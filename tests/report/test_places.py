"""The table of a matrix's points at which a setting fails."""

from __future__ import annotations

from typing import Any

from safevar_sumo.report.input import AVOIDED, failing_places
from safevar_sumo.scenarios import Point


def point(name: str, **place: Any) -> Point:
    return Point(None, None, name, tuple(place.items()))  # type: ignore[arg-type]


def test_tests_and_weathers_stand_down_and_speeds_across() -> None:
    matrix = [*(point(f"near {speed} {at}", test="near", speed=speed, impact_location=at, weather="night")
                for speed in (10, 20, 30) for at in (25, 50)),
              point("along 30", test="along", speed=30, weather="clear"), point("along 40", test="along", speed=40, weather="clear"),
              point("safe 10", test="safe", speed=10, weather="clear")]
    found = failing_places(matrix, ("near 20 50", "near 30 25", "near 30 50", "along 40"))
    assert found["told"] == "Fails at 4 of 9 points. Percentages are impact locations."
    assert found["heads"] == ["10 km/h", "20 km/h", "30 km/h", "40 km/h"]
    assert dict(found["rows"]) == {"near, night": [AVOIDED, "50 %", "25 %, 50 %", ""], "along, clear": ["", "", AVOIDED, "fails"]}


def test_a_matrix_of_something_else_than_speeds_has_a_table_too() -> None:
    found = failing_places([point("a", test="a", weather="fog", slope=0.1), point("b", test="b", weather="fog")], ["a"])
    assert (found["heads"], found["rows"]) == ([""], [("a, fog, slope 0.1", ["fails"])])
    assert failing_places([point("b", test="b", weather="fog")], [])["rows"] == []
