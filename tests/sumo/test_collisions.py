"""Collisions are those of bodies, whatever options, shapes and lengths a user's network has, and as
bad as they are fast.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import safevar_sumo as sv
from safevar_sumo.errors import InputError
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.network_check import network_remarks
from tests.support.in_process import SLOW, json_of, own_network, rewrite, rows_of
from tests.support.made_up import changed, system_of

OPTIONS = {
    "none at all": {},
    "SUMO's minGap": {"collision.action": "warn", "collision.check-junctions": "true"},
    "accidents ignored": {"ignore-accidents": "true"},
    "colliders removed": {
        "collision.action": "remove",
        "intermodal-collision.action": "remove",
        "collision.mingap-factor": "0",
        "collision.check-junctions": "true",
    },
    "colliders teleported": {
        "collision.action": "teleport",
        "time-to-teleport": "1",
    },
    "colliders stop": {
        "collision.action": "warn",
        "collision.stoptime": "9",
        "time-to-teleport.highways": "2",
    },
    "junctions unchecked": {"collision.action": "warn", "collision.mingap-factor": "0"},
    "steps of Euler": {"step-method.ballistic": "false"},
}
"""Options of collisions in a user's file."""
WIZARD = """<sumoConfiguration>
    <input><net-file value="network.net.xml"/><route-files value="traffic.rou.xml"/></input>
    <output><tripinfo-output value="tripinfos.xml"/><statistic-output value="stats.xml"/></output>
    <processing>
        <ignore-route-errors value="true"/><tls.actuated.jam-threshold value="30"/>
    </processing>
    <routing>
        <device.rerouting.adaptation-steps value="18"/>
        <device.rerouting.adaptation-interval value="10"/>
    </routing>
    <report>
        <verbose value="true"/><duration-log.statistics value="true"/><no-step-log value="true"/>
    </report>
</sumoConfiguration>
"""
"""Options as SUMO's web wizard writes them."""
WEAK_BRAKES = {"brakeGain": 0.6, "reactionTime": 0.8}


def set_options(folder: Path, options: dict[str, str]) -> None:
    file = folder / "scenario.sumocfg"
    text = re.sub(r".*(ollision|ballistic|teleport).*\n", "", file.read_text())
    elements = "".join(
        f'\n<{name} value="{value}"/>' for name, value in options.items()
    )
    file.write_text(text.replace("<processing>", f"<processing>{elements}"))


def simulated(
    base: str, network: Path, changes: dict[str, float], **tables: object
) -> sv.Simulation:
    scenario = {"model": network.name, "parameters": {"network": str(network)}}
    return sv.simulate(
        {"extends": base, "name": "mine", "scenario": scenario, **tables}, changes
    )


@SLOW
@pytest.mark.parametrize("options", OPTIONS)
def test_no_option_of_a_users_file_decides_what_a_collision_is(
    options: str, tmp_path: Path
) -> None:
    stopped = own_network(tmp_path / "lead_vehicle_stopped", "lead_vehicle_stopped")
    crossing = own_network(tmp_path / "pedestrian_crossing")
    for network in (stopped, crossing):
        set_options(network, OPTIONS[options])
    unsafe = simulated("native", stopped, WEAK_BRAKES)
    assert (unsafe.original.outcome, unsafe.outcome) == ("stopped", "collision")
    assert (unsafe.original.gap, unsafe.metrics["safety_degree"]) == pytest.approx(
        (2.27, -6.62), abs=0.005
    )
    hit = simulated(
        "rain",
        crossing,
        {"tireFric": 1.0, "maxBrakeTorque": 1200.0, "dampRateZeroT_CE": 1.0},
    )
    assert hit.metrics["safety_degree"] == pytest.approx(-2.80, abs=0.005)


@SLOW
def test_options_of_the_web_wizard_give_the_same_answer_and_leave_json_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """It names outputs, and no time step, with SUMO's of which the original collides."""
    network = own_network(tmp_path / "lead_vehicle_stopped", "lead_vehicle_stopped")
    (network / "scenario.sumocfg").write_text(WIZARD)
    files = {*network.iterdir()}
    study = tmp_path / "mine.toml"
    study.write_text(
        'extends = "native"\nname = "mine"\n[scenario]\nmodel = "lead_vehicle_stopped"\n'
        f'parameters = {{ network = "{network}" }}\n'
    )
    changes = [f"{name}={value}" for name, value in WEAK_BRAKES.items()]
    answer = json_of(f"simulate {study} --set {changes[0]} --set {changes[1]} --json")
    shipped = sv.simulate(
        {"extends": "native", "name": "finer", "step_length": 0.05}, WEAK_BRAKES
    )
    assert answer["numbers"]["safety_degree"] == shipped.metrics["safety_degree"] < 0
    assert rows_of(answer, "results")[0]["original"] == "stopped"
    assert capfd.readouterr().out == ""  # of SUMO itself
    assert {*network.iterdir()} == files
    remarks = str(answer["tables"]["remarks"])
    assert "has no step-length: 0.05 s unless the study has `step_length`" in remarks
    assert "tripinfo-output = tripinfos.xml (NUL counts)" in remarks


@SLOW
def test_one_remark_names_the_options_that_are_overruled(tmp_path: Path) -> None:
    network = own_network(tmp_path / "mine", "lead_vehicle_stopped")
    assert network_remarks(str(network)) == []
    for options in (
        {
            "step-method.ballistic": "1",
            "collision.action": "warn",
            "collision.mingap-factor": "0.0",
        },
        {
            "step-method.ballistic": "true",
            "time-to-teleport": "0",
            "time-to-teleport.bidi": "-5",
        },
    ):
        set_options(network, options)
        assert network_remarks(str(network)) == []
    set_options(
        network,
        {
            "step-method.ballistic": "true",
            "time-to-teleport": "300",
            "collision.action": "none",
        },
    )
    (remark,) = network_remarks(str(network))
    assert (
        "scenario.sumocfg: no effect: collision.action = none (warn counts), time-to-teleport = 300"
        in remark
    )
    set_options(network, {})
    (remark,) = network_remarks(str(network))
    assert "step-method.ballistic = false (true counts)" in remark


@SLOW
def test_the_corners_of_a_car_are_not_cut_off_by_its_shape(tmp_path: Path) -> None:
    """SUMO cuts the corners of a `passenger`, and sees no pedestrian there: of this setting it
    would say "stops".
    """
    network = own_network(tmp_path / "pedestrian_crossing")
    settings = {
        "max_rpm": 5906.0,
        "dampRateFullT": 0.145,
        "dampRateZeroT_CE": 1.0,
        "dampRateZeroT_CD": 0.3339,
        "gearSwitchTime": 0.5013,
        "clutchStrength": 10.39,
        "mass": 2405.0,
        "dragCoeff": 0.2784,
        "tireFric": 1.162,
        "dampRate": 0.2509,
        "radius": 35.59,
        "maxBrakeTorque": 1211.0,
    }
    expected = simulated("rain", network, settings)
    assert expected.outcome == "collision"
    rewrite(network / "traffic.rou.xml", (' guiShape="evehicle"', ""))
    assert simulated("rain", network, settings).to_dict() == expected.to_dict()


def test_a_body_in_the_path_that_sumo_does_not_see_is_an_error_with_its_time(
    tmp_path: Path,
) -> None:
    """The parked vehicle stands in the next lane and reaches 0.35 m into the vehicle's path."""
    network = own_network(tmp_path / "lead_vehicle_stopped", "lead_vehicle_stopped")
    rewrite(
        network / "traffic.rou.xml",
        (
            'id="parked_beside" type="parked" depart="0" departLane="1" departPos="85"',
            'id="parked_beside" type="parked" depart="0" departLane="0" departPos="130"',
        ),
        ('lane="road_1" endPos="85"', 'lane="road_0" endPos="130"'),
        (
            'depart="0" departLane="0" departPos="85"',
            'depart="0" departLane="1" departPosLat="-2" departPos="85"',
        ),
        ('lane="road_0" endPos="85"', 'lane="road_1" endPos="85"'),
    )
    assert simulated("native", network, {}).outcome == "stopped"
    with pytest.raises(
        InputError,
        match=r"at 7\.6 s the front of the vehicle under test is 0\.\d\d m inside a body",
    ):
        simulated("native", network, WEAK_BRAKES)


@SLOW
@pytest.mark.parametrize(
    ("own", "other", "centres"),
    [("16.5", "4.7", 12.87), ("4.7", "12", 10.62)],
)
def test_centres_are_half_of_both_lengths_apart_where_bodies_touch(
    own: str, other: str, centres: float, tmp_path: Path
) -> None:
    network = own_network(tmp_path / "lead_vehicle_stopped", "lead_vehicle_stopped")
    shift = float(other) - 4.7  # the rear stays where it is
    rewrite(
        network / "traffic.rou.xml",
        (
            'id="vut" vClass="passenger" length="4.7"',
            f'id="vut" vClass="passenger" length="{own}"',
        ),
        (
            'id="parked" vClass="passenger" length="4.7"',
            f'id="parked" vClass="passenger" length="{other}"',
        ),
        ('departPos="85"', f'departPos="{85 + shift}"'),
        ('endPos="85"', f'endPos="{85 + shift}"'),
    )
    simulation = simulated("native", network, {})
    assert (simulation.metrics["safety_degree"], simulation.gap) == pytest.approx(
        (centres, 2.27), abs=0.005
    )


@pytest.mark.parametrize(
    ("parameters", "other"),
    [({"test": "CCRm", "speed": 60}, 20 / 3.6), ({"test": "CCRs", "speed": 50}, 0.0)],
)
def test_a_hit_on_a_moving_car_is_as_bad_as_it_closes(
    parameters: dict[str, object], other: float
) -> None:
    """`relative_impact_speed` is that of the moment of contact, within the last step."""
    scenario = {"model": "car_to_car", "parameters": parameters}
    system = system_of("sun", scenario=scenario, ads={"model": "aeb"})
    weak = changed(system, maxBrakeTorque=600.0, tireFric=0.5)
    ((_, evaluations, runs),) = simulate_all_points(system, weak)
    assert evaluations.outcome[0] == "collision"
    assert evaluations.f_safe[0] == pytest.approx(
        other - runs.collision_speed[0], abs=1e-9
    )
    assert (
        -evaluations.f_safe[0]
        <= runs.relative_speed[0]
        < -evaluations.f_safe[0] + 10 * runs.trace.step
    )
