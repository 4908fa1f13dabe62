"""Ego's own speeds: a robot drives them until the driving system is switched on, or brakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.ads import Ads
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import STEP, Played, play
from safevar_sumo.scenarios import OpenScenario
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.in_process import run
from tests.made_up import original_of
from tests.openscenario.writing import (
    AT_ONCE,
    at,
    event,
    group,
    lane_change,
    private,
    speed,
    staged,
    teleport,
    trigger,
    watching,
    world,
    write,
)
from tests.scenarios.holding import CARLA, NATIVE, Hold, Pedals, driven

ACTIVATE = "<ControllerAction><ActivateControllerAction {}/></ControllerAction>"
STANDING = private("Ego", teleport(at(-1, 50)), speed(0))
FASTER = event(speed(20, "linear", "time", 5), AT_ONCE.format(1), "Faster")
STOP = trigger(AT_ONCE.format(20), "")


def played(folder: Path, *events: str, car: str = "", ego: str = STANDING, **parts: str) -> Played:
    """What a file says in which Ego and the Car have these events."""
    groups = (group(*events, actor="Ego") if events else "") + (group(car) if car else "")
    return staged(folder, groups=groups, ego=ego, stop=STOP, **parts)  # type: ignore[arg-type]


def begins(scene: Played) -> float:
    """When the Car begins to change its lane [s]."""
    (car,) = scene.others
    return float(np.flatnonzero(np.abs(np.diff(car.facing.imag)) > 1e-6)[0] * STEP)


def when(condition: str) -> str:
    """The Car's event that begins with a condition on Ego."""
    return event(lane_change(-1, "linear", "time", 2), watching("Ego", condition), "Aside")


def test_a_speed_that_is_met_at_the_end_of_the_profile_is_known(tmp_path: Path) -> None:
    """10 m/s at 3 m/s^2 take 3.333 s, between two samples; a step takes none; and a scene that ends
    before, as Ego stands for 1 s, has no end of the profile.
    """
    car = when('<SpeedCondition value="9.99" rule="greaterThan"/>')
    at_start = private("Ego", teleport(at(-1, 50)), speed(10, "linear", "rate", 3))
    assert begins(played(tmp_path, ego=at_start, car=car)) == pytest.approx(3.34)
    step = event(speed(10), AT_ONCE.format(1), "Step")
    assert begins(played(tmp_path, step, car=car)) == pytest.approx(1.01)
    stop = trigger(watching("Ego", '<StandStillCondition duration="1"/>'), "")
    slow = event(speed(10, "linear", "time", 20), AT_ONCE.format(3), "Slow")
    file = write(tmp_path, groups=group(slow, actor="Ego") + group(car), ego=STANDING, stop=stop)
    assert play(file, {}).duration == pytest.approx(5)


def test_ego_accelerates_and_then_keeps_its_speed(tmp_path: Path) -> None:
    """From 1 s on by 4 m/s^2 to 20 m/s; nothing switches a driving system on before 6 s."""
    scene = played(tmp_path, FASTER)
    times = np.arange(len(scene.profile)) * STEP
    assert times[-1] == pytest.approx(6)
    assert np.abs(scene.profile - 4 * np.clip(times - 1, 0, 5)).max() < 1e-9
    assert scene.speed == 20
    assert "until the driving system is switched on at 6.0 s" in " ".join(scene.remarks)
    at_start = private("Ego", teleport(at(-1, 50)), speed(20, "linear", "time", 5))
    assert len(played(tmp_path, ego=at_start).profile) == 501


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ('<TraveledDistanceCondition value="18"/>', 4.0),  # 2 m/s^2 t^2 after 3 s
        ('<SpeedCondition value="10" rule="greaterThan"/>', 3.5),
        ('<AccelerationCondition value="3" rule="greaterThan"/>', 1.01),
        ('<TraveledDistanceCondition value="90"/>', 8.0),  # 50 m by 6 s, then 20 m/s
    ],
)
def test_what_waits_for_ego_waits_for_its_own_speed(
    tmp_path: Path, condition: str, expected: float
) -> None:
    scene = played(tmp_path, FASTER, car=when(condition))
    assert begins(scene) == pytest.approx(expected, abs=2 * STEP)
    assert scene.depends_until == pytest.approx(expected, abs=2 * STEP)


def test_a_master_arrives_when_its_speeds_say(tmp_path: Path) -> None:
    """Ego reaches s = 150 m at 8.5 s: 50 m by 6 s, and 50 m at 20 m/s."""
    action = (
        f'<SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster>{at(-1, 150)}'
        f"</TargetPositionMaster><TargetPosition>{at(-2, 200)}</TargetPosition>"
        '<FinalSpeed><AbsoluteSpeed value="12"/></FinalSpeed></SynchronizeAction>'
    )
    start = trigger(AT_ONCE.format(1))
    (car,) = played(tmp_path, FASTER, car=event(action, start, priority="parallel")).others
    index = round(8.5 / STEP)
    assert (car.place - 1.5 * car.facing)[index].real == pytest.approx(10 + 200, abs=0.05)
    assert car.speed[index] == pytest.approx(12)


@pytest.mark.parametrize("longitudinal", ["longitudinal='true'", ""])
def test_a_driving_system_is_switched_on_by_its_action(tmp_path: Path, longitudinal: str) -> None:
    """At 4 s, when Ego drives at 12 m/s."""
    on = event(ACTIVATE.format(longitudinal), AT_ONCE.format(4), "On", "parallel")
    scene = played(tmp_path, FASTER, on)
    assert (len(scene.profile) - 1) * STEP == pytest.approx(4, abs=STEP)
    assert scene.speed == pytest.approx(12)
    off = event(ACTIVATE.format("longitudinal='false'"), AT_ONCE.format(4), "Off", "parallel")
    assert played(tmp_path, FASTER, off).speed == 20


@pytest.mark.parametrize("system", [CARLA, NATIVE], ids=["carla", "native"])
def test_a_robot_drives_the_profile_and_holds_its_last_speed(
    tmp_path: Path, system: object
) -> None:
    file = write(tmp_path, groups=group(FASTER, actor="Ego"), ego=STANDING, stop=STOP)
    run = driven(OpenScenario(file), system=system)  # type: ignore[arg-type]
    times, speeds = run.trace.time, run.trace.speed[:, 0]
    assert np.abs(speeds - 4 * np.clip(times - 1, 0, 5))[(times <= 6.0)].max() < 1e-6
    assert abs(run.test_speed_error[0]) < 1.0 / 3.6
    assert run.outcome[0] in ("passed", "timeout")


def test_the_first_brake_ends_the_profile(tmp_path: Path) -> None:
    """At 3 s, at 8 m/s. What is an invalid test if another one still waits for Ego; to release an
    accelerator ends nothing.
    """
    brakes: Ads = Hold(np.array([3.0]))
    waits = when('<TraveledDistanceCondition value="90"/>')
    for car, outcome in (("", "stopped"), (waits, "invalid-test")):
        groups = group(FASTER, actor="Ego") + (group(car) if car else "")
        run = driven(OpenScenario(write(tmp_path, groups=groups, ego=STANDING, stop=STOP)), brakes)
        assert run.trace.speed.max() == pytest.approx(8, abs=0.3)
        assert run.outcome[0] == outcome
    releases = Pedals(lambda seen: (np.where(seen.time < 2, 1.0, 0.0), 0.0))
    file = write(tmp_path, groups=group(FASTER, actor="Ego"), ego=STANDING, stop=STOP)
    assert driven(OpenScenario(file), releases).trace.speed.max() == pytest.approx(20, abs=0.3)


@pytest.mark.slow
def test_the_driving_system_sees_while_the_robot_leads(tmp_path: Path) -> None:
    """A car stands 30 m ahead: the system brakes before Ego is at its test speed."""
    car = teleport(at(-1, 84)), speed(0)
    file = write(tmp_path, groups=group(FASTER, actor="Ego"), ego=STANDING, stop=STOP, car=car)
    study = tmp_path / "mine.toml"
    study.write_text(f'extends = "wear"\nname = "mine"\n[scenario]\nfile = "{file}"\n')
    assert "The original vehicle stops" in run("simulate", str(study)).stdout


@pytest.mark.slow
def test_searched_profiles_are_those_of_each_value_and_of_sumo(tmp_path: Path) -> None:
    """Ego accelerates to v in 5 s; a Car stands 200 m ahead. At 6 m/s Ego does not get there."""
    file = write(
        tmp_path,
        groups=group(event(speed("$v", "linear", "time", 5), AT_ONCE.format(1)), actor="Ego"),
        ego=STANDING,
        stop=STOP,
        parameters='<ParameterDeclaration name="v" parameterType="double" value="15"/>',
        car=(teleport(at(-1, 250)), speed(0)),
    )
    search = {"v": {"lower": 5.0, "upper": 30.0, "original": 15.0}}
    system = assemble(
        load_study("wear", scenario={"file": file, "over": search}, encounters="ranges")
    )
    members = system.characteristics
    values = 6.0, 15.0, 22.0, 30.0
    settings = np.tile(members.original, (len(values), 1))
    settings[:, members.names.index("v")] = values
    searched = drive_and_score(system, settings)
    in_sumo = drive_and_score(replace(system, in_sumo=True), settings)
    assert np.array_equal(searched.f_safe, in_sumo.f_safe, equal_nan=True)
    assert searched.outcome.tolist() == ["invalid-test", "stopped", "stopped", "collision"]
    for value, degree in list(zip(values, searched.f_safe, strict=True))[1:]:
        own = assemble(load_study("wear", scenario={"file": file, "values": {"v": value}}))
        assert drive_and_score(own, original_of(own)).f_safe[0] == pytest.approx(degree, abs=1e-9)


@pytest.mark.parametrize("kind", ["AssignRouteAction", "AcquirePositionAction"])
def test_a_route_of_ego_after_the_start_straight_on_changes_nothing(
    tmp_path: Path, kind: str
) -> None:
    """Its waypoints may be places in the plane: y of the lane is 18, its road begins at x = 10."""
    points = [f"<Position>{world(x, 18)}</Position>" for x in (60, 900)]
    inner = points[-1]
    if kind == "AssignRouteAction":
        inner = f"<Route>{''.join(f'<Waypoint>{one}</Waypoint>' for one in points)}</Route>"
    route = event(f"<RoutingAction><{kind}>{inner}</{kind}></RoutingAction>", AT_ONCE.format(1))
    moving = private("Ego", teleport(world(60, 18)), speed(20))
    scene, plain = (played(tmp_path, *one, ego=moving) for one in ((route,), ()))
    assert scene.speed == plain.speed == 20
    assert np.abs(scene.others[0].place - plain.others[0].place).max() < 1e-9
    assert scene.events[0][2] == pytest.approx(1)
    with pytest.raises(InputError, match="a waypoint that is not on a road"):
        played(tmp_path, route.replace('x="900"', 'x="9000"'), ego=moving)


def test_criteria_of_carlas_scenario_runner_do_not_end_a_scene(tmp_path: Path) -> None:
    condition = '<ParameterCondition parameterRef="" value="" rule="lessThan"/>'
    criterion = trigger(condition, "").replace('name=""', 'name="criteria_CollisionTest"')
    scene = staged(tmp_path, stop=criterion + trigger(AT_ONCE.format(7), ""))
    assert scene.duration == pytest.approx(11)
    assert "without effect here: criteria_CollisionTest" in scene.remarks
