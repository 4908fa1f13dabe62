"""What a command prints by default is one screen that a person reads to its end."""

from __future__ import annotations

import re
import textwrap

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.permit.answer import SHOWN_WHOLE
from safevar_sumo.study import study_names
from tests.in_process import run

STUDY = load_study("smoke")
WIDTH, MAX_LINES = 100, 30
FEW = {"simulate": (), "rules": ("--samples", "64")}
"""Questions that each study answers within seconds, with their options."""
SAMPLES = "--samples 64"
SHORT = "--quick --limit 60 --top 1"
OTHERS = (
    *(f"risk {name} {SAMPLES}" for name in ("smoke", "native", "wear", "sun", "r13h")),
    *(f"explain {name} {SHORT}" for name in ("smoke", "native", "sun", "alks_joint_following")),
    "tolerance native --quick",
    "tolerance wear --quick --characteristics treadDepth,payload",
    "tolerance smoke --quick --characteristics tireFric,mass",
    "compare sun smoke --samples 64",
    "permit wear_fleet --set treadDepth=3 --set payload=300 --set brakeTorque=1 --quick",
    "rating euro_ncap_rating --set treadDepth=3",
    "repair autoware_july --promise brakeTorque>=0.9 --quick",
    "study smoke --runs 1 --evaluations 60 --out results",
    "check smoke",
)
SLOW = "metadrive_expert"
TYPED = [
    *(f"{name} {study}" for study in study_names() if study != SLOW for name in FEW),
    *(f"simulate {SLOW}", f"rules {SLOW} --simulations 60"),
    *OTHERS,
]


def printed(typed: str) -> str:
    words = typed.split()
    output = run(*words, *FEW.get(words[0], ()) if len(words) == 2 else (), expect=None)
    assert output.stdout or "expected: " in output.stderr, "an answer, or why there is none"
    return output.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize("typed", TYPED)
def test_an_answer_is_one_screen(typed: str) -> None:
    text = printed(typed)
    if not text:
        assert typed not in OTHERS
        return
    lines = [part for line in text.splitlines() for part in textwrap.wrap(line, WIDTH) or [""]]
    assert len(lines) <= MAX_LINES, text
    assert max(map(len, lines)) <= WIDTH, "no table is wider"
    assert text.count("Valid for: ") <= 1
    assert "Scope: " not in text
    assert not re.search(r"^\w+: [^;]*; \w+: [^;]*; \w+: ", text, re.MULTILINE), "pairs"
    assert "More: --details" in text

    # Neither a column that says the same in each row, nor more than one table.
    rows = [re.split("[│┃]", line)[1:-1] for line in lines if line.startswith("│")]
    assert text.count("┏") <= 1
    whole = [row for row in rows if row[0].strip()]
    for cells in list(zip(*whole, strict=True))[1:] if len(whole) > 1 else []:
        assert len({*map(str.strip, cells)}) > 1, cells


@pytest.mark.parametrize(("number", "shown"), [(13, 13), (50, 50), (51, 12)])
def test_a_list_of_up_to_50_cars_is_whole(number: int, shown: int) -> None:
    table = tabulate("Cars", {"car": ""}, [[f"<{row}>"] for row in range(number)])
    table.attrs["shown_whole"] = SHOWN_WHOLE
    answer = Answer(question="", study=STUDY, verdict="", numbers={}, tables={"cars": table})
    text = answer.render("text")
    assert len(re.findall("<[0-9]+>", text)) == shown
    assert ("39 more rows: --details" in text) == (number == 51)
