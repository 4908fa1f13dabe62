"""What a study's identity tells, and workers that have other files than the campaign."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import changes
from safevar_sumo.results.manifest import LAYERS
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import evaluate_batch, packed
from safevar_sumo.workers.identity import identity_of, networks_of, powers_digest


def test_names_and_defaults_are_resolved_to_numbers() -> None:
    study = load_study("rain")
    identity = identity_of(study, assemble(study))
    assert set(identity) <= set(LAYERS)
    assert json.dumps(identity, allow_nan=False)
    assert identity["resolved"]["weather"]["hesitation"] > 0
    given = load_study("rain", ads={"parameters": {}}).ads.parameters
    resolved = identity["resolved"]["ads"]["parameters"]
    assert set(resolved) >= set(given)
    assert "duration" in identity["resolved"]["scenario"]["parameters"], "a default"
    assert not {"title", "published", "calibration"} & set(identity["resolved"])
    assert not {"runs", "algorithms", "evaluations", "time_limit"} & set(identity["resolved"]["search"])


def test_other_numbers_of_a_weather_are_another_study() -> None:
    one, other = (load_study("sun", weather={"name": "mine", "road_friction": friction, "visibility": 1.0}) for friction in (0.9, 0.8))
    assert identity_of(one, assemble(one)) != identity_of(other, assemble(other))


def test_what_a_characteristic_means_is_no_part_of_a_studys_identity() -> None:
    study = load_study("native")
    bare = {name: msgspec.structs.replace(row, meaning="", counterpart="") for name, row in study.vehicle.characteristics.items()}
    other = msgspec.structs.replace(study, vehicle=msgspec.structs.replace(study.vehicle, characteristics=bare))
    assert study.vehicle.characteristics["mass"].meaning
    assert identity_of(other, assemble(other)) == identity_of(study, assemble(study))
    assert not {"meaning", "counterpart"} & set(identity_of(study, assemble(study))["resolved"]["vehicle"]["characteristics"]["mass"])


@pytest.mark.parametrize("file", ["scenario.sumocfg", "network.nod.xml", "network.netccfg"])
def test_every_file_of_a_network_that_results_hang_on_counts(file: str, tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", tmp_path / "mine")
    study = load_study("native", scenario={"parameters": {"network": str(tmp_path / "mine")}})
    before = networks_of(assemble(study))
    text = (tmp_path / "mine" / file).read_text()
    (tmp_path / "mine" / file).write_text(text + "<!-- -->")
    after = networks_of(assemble(study))
    assert changes(before, after) == [file]


def test_a_network_that_changes_between_two_batches_is_noticed(tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", tmp_path / "mine")
    study = load_study("native")
    study = msgspec.structs.replace(study, scenario=msgspec.structs.replace(study.scenario, parameters={"network": str(tmp_path / "mine")}))
    work, original = packed(study), CharacteristicSet.of(study.vehicle.characteristics).original[None]
    evaluate_batch(work, original)
    traffic = tmp_path / "mine" / "traffic.rou.xml"
    traffic.write_text(traffic.read_text() + "<!-- -->")
    with pytest.raises(InputError, match=r"traffic\.rou\.xml: is not the file"):
        evaluate_batch(work, original)


def test_powers_that_are_rounded_differently_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    before = powers_digest()
    monkeypatch.setattr("safevar_sumo.workers.identity.EXPONENTS", (1 / 21 * (1 + 2**-52), 1 / 20, -21.0, 21.0))
    assert powers_digest() != before
