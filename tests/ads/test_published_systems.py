"""Published driving systems behind the interface decide as their own libraries and formulas do, and
what goes wrong there is told in two lines.
"""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from safevar_sumo.ads.highway_idm import HighwayIdm
from safevar_sumo.ads.intel_rss import AdRss
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.records import Observation
from safevar_sumo.sumo.matrix import simulate_all_points
from tests.support.in_process import run
from tests.support.made_up import MISSING, original_of, system_of
from tests.support.pedals import COASTING, FULL, KNOWN

needs_ad_rss = pytest.mark.skipif(
    "wear_rss" in MISSING, reason="the extra ad-rss is missing"
)


def seen(
    speed: float,
    gap: float,
    leader: float = 0.0,
    lateral: float = 0.0,
    time: float = 0.0,
) -> Observation:
    return Observation(
        time, speed, gap, speed - leader, lateral, 0.0, 1.0, leader, obstacle_width=1.8
    )  # type: ignore[arg-type]


def rss_distance(v: float, u: float, **rule: float) -> float:
    """The safe distance of Shalev-Shwartz, Shammah and Shashua (2017), equation 2, and what is kept
    in addition [m].
    """
    rt, a = rule["response_time"], rule["accel_max"]
    stop = v * rt + a * rt * rt / 2 + (v + a * rt) ** 2 / (2 * rule["brake_min"])
    distance = max(stop - u * u / (2 * rule["brake_max"]), 0.0)
    return distance + rule["min_longitudinal_safety_distance"]


@needs_ad_rss
@pytest.mark.parametrize(("speed", "leader"), [(50, 0), (80, 0), (60, 20), (30, 50)])
@pytest.mark.parametrize("response_time", [0.5, 1.0])
def test_ad_rss_brakes_below_the_published_safe_distance(
    speed: float, leader: float, response_time: float
) -> None:
    rule = {
        "response_time": response_time,
        "accel_max": 3.5,
        "brake_min": 4.0,
        "brake_max": 8.0,
        "min_longitudinal_safety_distance": 1.0,
    }
    v, u = speed / 3.6, leader / 3.6
    expected = rss_distance(v, u, **rule)
    for gap, brake in ((expected - 0.002, 1.0), (expected + 0.002, 0.0)):
        driver = AdRss(**rule)
        driver.start(KNOWN, 0.05)
        assert driver.drive(seen(v, gap, u))[1] == brake


@needs_ad_rss
def test_ad_rss_holds_its_speed_before_it_brakes_and_releases_the_accelerator_after() -> (
    None
):
    driver = AdRss()
    driver.start(KNOWN, 0.05)
    assert driver.drive(seen(10.0, 200.0)) == pytest.approx(
        ((COASTING / (FULL + COASTING)), 0.0)
    )
    assert driver.drive(seen(9.0, 200.0)) == pytest.approx(
        ((1 + COASTING) / (FULL + COASTING), 0)
    )
    assert driver.drive(seen(10.0, 5.0, lateral=3.0))[1] == 0, "beside its corridor"
    assert driver.drive(seen(10.0, 5.0)) == (0.0, 1.0)
    assert driver.drive(seen(5.0, math.inf)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("speed", "gap", "leader"),
    [(10.0, 60.0, 0.0), (14.0, 60.0, 0.0), (14.0, 25.0, 10.0)],
)
def test_highway_idm_accelerates_by_the_published_formula(
    speed: float, gap: float, leader: float
) -> None:
    """Treiber, Hennecke and Helbing (2000) with the library's numbers; a gap of 5 m at
    standstill, and lengths of 5 m between the middles.
    """
    a, b, target = 3.0, 5.0, 13.9
    wanted = 10.0 + 1.5 * speed + speed * (speed - leader) / (2 * math.sqrt(a * b))
    expected = a * (1 - (speed / target) ** 4) - a * (wanted / (gap + 5.0)) ** 2
    driver = HighwayIdm(target_speed=target)
    driver.start(KNOWN, 0.05)
    assert driver.drive(seen(speed, gap, leader)) == pytest.approx(
        driver.pedals(expected, speed)
    )
    assert driver.drive(seen(speed, gap, leader)) != driver.drive(seen(speed, math.inf))


@pytest.mark.parametrize(
    ("study", "numbers"),
    [
        pytest.param("wear_rss", ("response_time", 0.5, 2.0), marks=needs_ad_rss),
        ("wear_idm", ("target_speed", None, 20.0)),
    ],
)
def test_the_original_of_their_studies_is_safe_and_a_parameter_acts(
    study: str, numbers: tuple[str, float | None, float]
) -> None:
    name, today, other = numbers
    found = []
    for value in (today, other):
        ads = {"model": load_study(study).ads.model, "parameters": {name: value}}
        system = system_of(study, ads=ads)
        results = simulate_all_points(system, original_of(system))
        found.append(np.array([result.evaluations.f_safe[0] for result in results]))
    assert (found[0] > 1).all()
    assert (found[0] != found[1]).all()


@pytest.mark.parametrize(
    ("model", "module", "extra"),
    [
        ("ad_rss", "ad_rss", "ad-rss"),
        ("highway_idm", "highway_env.road.road", "highway-env"),
    ],
)
def test_without_its_library_the_extra_is_named(
    model: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError) as error:
        system_of("wear", ads={"model": model, "parameters": {}})
    assert f"needs {extra}" in error.value.problem
    assert error.value.legal == f"in the checkout: pip install '.[{extra}]'"
    assert len(str(error.value).splitlines()) == 2


@needs_ad_rss
@pytest.mark.parametrize(
    ("name", "value", "legal"),
    [
        ("response_time", "-1.0", "a number above 0, up to 1000"),
        ("accel_max", "1e9", "a number above 0, up to 1000"),
        ("brake_min", "9.0", "a number above 0, up to 8"),
        ("brake_max", "-1.0", "a number above 0, up to 1000"),
        ("brake_max", "2e3", "a number above 0, up to 1000"),
    ],
)
def test_numbers_that_its_library_refuses_are_refused_without_its_log(
    in_tmp: object, capfd: pytest.CaptureFixture[str], name: str, value: str, legal: str
) -> None:
    """The library logs past Python's stderr."""
    with open("own.toml", "w", encoding="utf-8") as file:
        file.write(
            f'extends = "wear_rss"\nname = "own"\n[ads.parameters]\n{name} = {value}\n'
        )
    first, second = run("simulate own.toml", expect=2).stderr.strip().splitlines()
    assert first.endswith(f"own.toml: ads.parameters.{name} = {float(value):g}")
    assert second == f"expected: {legal}"
    assert capfd.readouterr().err.count("[error]") == 0
