"""Numbers of records in words."""

from __future__ import annotations

import pytest

from safevar_sumo.records import significant


@pytest.mark.parametrize("digits", [2, 3, 5])
def test_numbers_up_to_99_999_have_no_exponent(digits: int) -> None:
    for value in (99.95, 1259.0, -1259.0, 12345.6, 99_999.0, 99_999.4):
        text = significant(value, digits)
        assert "e" not in text
        assert float(text) == pytest.approx(value, rel=10 ** (1 - digits))
    assert significant(0.123456, digits) == f"{0.123456:.{digits}g}"
