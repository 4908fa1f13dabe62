"""All pictures of the pages, drawn anew: `python docs/scripts/pictures.py [NAME]...`, by default
every one.

Those of published data need the files that `SAFEVAR_PUBLISHED` names the folder of; that of the
page needs Chromium.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

SCRIPTS = Path(__file__).parent
PROGRAM = f"{shlex.quote(sys.executable)} -m safevar_sumo"
FAILURE = (
    f"{PROGRAM} simulate rain --set dampRateZeroT_CE=1 --set tireFric=1 --set"
    " maxBrakeTorque=1200"
)
PUBLISHED = Path(os.environ.get("SAFEVAR_PUBLISHED", "published")).resolve()
SCREEN = (
    "--headless --no-sandbox --disable-gpu --hide-scrollbars --window-size=1160,1772"
)
COMMANDS = {
    "failure.png": f"{FAILURE} --plot {{}}",
    "failure.gif": f"{FAILURE} --animate {{}}",
    "sawtooth.png": f"{shlex.quote(sys.executable)} {SCRIPTS}/boundaries.py sawtooth {{}}",
    "boundary.png": f"{shlex.quote(sys.executable)} {SCRIPTS}/boundaries.py boundary {{}}",
    "limits.png": f"{PROGRAM} tolerance native --characteristics decel,brakeDelay --plot {{}}",
    "convergence.png": (
        f"{PROGRAM} study rain --runs 5 --evaluations 2000 --out rain --quiet && "
        f"{PROGRAM} tables rain --figures . > /dev/null && cp rain-convergence.png {{}}"
    ),
    "stops.png": f"{shlex.quote(sys.executable)} {SCRIPTS}/stops.py {{}}",
    "encounters.png": f"{shlex.quote(sys.executable)} {SCRIPTS}/encounters.py {{}}",
    "sun_nsga2.png": f"{PROGRAM} validate sun {PUBLISHED}/sun_nsga2.csv --plot {{}}",
    "rain_nsga2_half.png": f"{PROGRAM} validate rain {PUBLISHED}/rain_nsga2_half.csv --plot {{}}",
    "lgsvl.png": f"{PROGRAM} validate lgsvl {PUBLISHED}/lgsvl_rs.csv --plot {{}}",
    "report.png": (
        f"{PROGRAM} study native --runs 1 --evaluations 100 --quiet && "
        f"{PROGRAM} report results/native --ask tolerance --out page.html && "
        f"chromium {SCREEN} --screenshot={{}} file://$PWD/page.html 2>/dev/null"
    ),
}
"""The command of each picture, in a folder of its own."""


def draw(name: str, folder: Path) -> Path:
    """Draw a picture into a folder."""
    picture = folder.resolve() / name
    with tempfile.TemporaryDirectory() as place:
        command = COMMANDS[name].format(shlex.quote(str(picture)))
        subprocess.run(
            command, shell=True, check=True, cwd=place, stdout=subprocess.DEVNULL
        )
    return picture


if __name__ == "__main__":
    for chosen in sys.argv[1:] or COMMANDS:
        print(draw(chosen, SCRIPTS.parent / "pictures"))
