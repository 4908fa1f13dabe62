"""README's commands on a machine that has nothing: `python3 -m tools.plain_machine`.

The package is installed alone into a new environment, as README says, without extras or packages of
the tests; this file needs none either. Commands run in empty directories with a new home. They are
those of README and of `PAGES`, as printed there. What README's table of questions quotes must be
part of what its command prints. What needs an extra must name it in two lines.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from csv import DictReader, writer
from pathlib import Path

from tools.manual import PROGRAM, ROOT, blocks, files_of

PAGES = {
    "docs/quickstart.md": ("study", "tables"),
    "docs/performance.md": ("list",),
    "docs/check.md": ("check",),
    "docs/evidence.md": ("study", "evidence", "verify"),
    "docs/take_along.md": ("study", "export"),
    "docs/trust.md": ("validate", "import"),
}
"""Pages, and the commands of each that run, in its order."""
SOLUTIONS = "results/rain/solutions.csv"
"""Solutions of README's study; some of them stand in for the published files of a page."""
PUBLISHED = {
    "safety_degree": "SaftyDegree",
    "tet": "TET",
    "tit": "TIT",
    "ave_dece": "Dece",
}
"""Columns of the published files by those of solutions."""
EXTRAS = {
    "study wear_rss": "ad-rss",
    "study wear_idm": "highway-env",
    "study with_pymoo.toml": "pymoo",
    "study with_fmu.toml": "fmu",
    "study smoke --cluster tcp://127.0.0.1:8786": "cluster",
    "study own_road.toml": "sumo",
}
"""Commands that need an extra; `check` of their studies needs it, too."""
STUDIES_OF_EXTRAS = {
    "with_pymoo.toml": '[search]\nalgorithms = ["pymoo:NSGA3"]',
    "with_fmu.toml": '[ads]\nkind = "fmu"\nmodel = "brake.fmu"',
    "own_road.toml": '[scenario.parameters]\nnetwork = "own_road"',
}
ANSWERS = (0, 3)
"""Exit codes of a question: 3 is a verdict against the vehicle or its driving system."""
INPUT_ERROR = 2
MAX_DISK = 1060
"""Largest size of an installation, as `du -m` counts it [MiB]."""


class Machine:
    """A new environment with the package alone, an empty home, and empty directories."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        subprocess.run([sys.executable, "-m", "venv", folder / "env"], check=True)
        subprocess.run(
            ["git", "clone", "--quiet", ROOT, folder / "checkout"], check=True
        )

    def run(self, line: str, place: str, codes: Sequence[int] = (0,)) -> str:
        """Run a line of a shell in a directory; returns what it prints.

        Raises
        ------
        SystemExit
            If it ends with another exit code, or prints a traceback.
        """
        where = self.folder / place
        where.mkdir(exist_ok=True)
        kept = {
            name: os.environ[name] for name in os.environ if name.startswith("PIP_")
        }
        path = f"{self.folder / 'env' / 'bin'}:/usr/bin:/bin"
        environment = {
            **kept,
            "PATH": path,
            "HOME": str(self.folder / "home"),
            "LANG": "C.UTF-8",
        }
        begin = time.monotonic()
        done = subprocess.run(
            line,
            check=False,
            shell=True,
            cwd=where,
            env=environment,
            capture_output=True,
            text=True,
        )
        printed = done.stdout + done.stderr
        print(f"{time.monotonic() - begin:6.1f} s  {line}", flush=True)
        if done.returncode not in codes or "Traceback" in printed:
            raise SystemExit(
                f"{line}: exit code {done.returncode}, not {codes}\n{printed}"
            )
        return printed


def installed_files(machine: Machine) -> None:
    """Every module, study and network of the checkout is installed."""
    checkout = machine.folder / "checkout"
    (site,) = (machine.folder / "env").glob("lib/*/site-packages")
    tracked = subprocess.run(
        ["git", "ls-files", "safevar_sumo", "studies", "sumo_nets"],
        cwd=checkout,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in tracked.stdout.splitlines():
        inside = Path("safevar_sumo", name.removeprefix("safevar_sumo/"))
        if (site / inside).read_bytes() != (checkout / name).read_bytes():
            raise SystemExit(f"{name} is another file in the wheel")


def read_me(machine: Machine) -> None:
    """README's commands, its files, and the questions of its table, whose examples are quotes."""
    for block in blocks("README.md"):
        if block.title:
            (machine.folder / "readme" / block.title).write_text(block.text)
        elif block.language == "bash":
            for line in block.text.splitlines():
                machine.run(line, "checkout" if line.startswith("pip") else "readme")
    for command, example in questions():
        printed = machine.run(PROGRAM + command, "readme", ANSWERS)
        quotes = re.findall('"(.+?)"', example)
        if not quotes:
            raise SystemExit(f"{command}: README quotes nothing of what it prints")
        for quoted in quotes:
            if quoted not in " ".join(printed.split()):
                raise SystemExit(
                    f"{command}: README quotes {quoted!r}, but it prints\n{printed}"
                )


def questions() -> Iterator[tuple[str, str]]:
    """Command and example of each row of README's table of questions."""
    rows = re.findall(r"^\|.*\|$", (ROOT / "README.md").read_text(), re.MULTILINE)
    head = next(i for i, row in enumerate(rows) if row.startswith("| question |"))
    for row in rows[head + 2 :]:
        if not row.startswith("| ["):
            break
        _, _, command, example, _ = (cell.strip() for cell in row.split("|"))
        yield command.strip("`"), example


def pages(machine: Machine) -> None:
    """The commands of `PAGES`, each page in a directory of its own."""
    for page, names in PAGES.items():
        place = Path(page).stem
        (machine.folder / place).mkdir()
        for name, text in files_of(page).items():
            (machine.folder / place / name).write_text(text)
        lines = [line for block in blocks(page) for line in block.text.splitlines()]
        commands = [
            line for line in lines if line.startswith(tuple(PROGRAM + n for n in names))
        ]
        missing = {*names} - {
            command.removeprefix(PROGRAM).split()[0] for command in commands
        }
        if missing:
            raise SystemExit(f"{page} has no command {min(missing)}")
        for command in commands:
            for name in re.findall(r"\S+_(?:nsga2|rs)\.csv", command):
                write_published(
                    machine.folder / "readme" / SOLUTIONS, machine.folder / place / name
                )
            machine.run(command, place)


def write_published(solutions: Path, path: Path) -> None:
    """Some solutions as a file in the published format, which has 0 for what is undefined."""
    with solutions.open(newline="") as read:
        rows = [*DictReader(read)][::100]
    columns = [*rows[0]]
    characteristics = columns[columns.index("run") + 1 : columns.index("f_safe")]
    with path.open("w", newline="") as written:
        file = writer(written)
        file.writerow([*characteristics, *PUBLISHED.values()])
        file.writerows(
            [row[name] or 0 for name in (*characteristics, *PUBLISHED)] for row in rows
        )


def extras(machine: Machine) -> None:
    """What needs an extra names it in two lines."""
    place = machine.folder / "extras"
    place.mkdir()
    for name, text in STUDIES_OF_EXTRAS.items():
        (place / name).write_text(f'extends = "smoke"\nname = "{name[:-5]}"\n{text}\n')
    (place / "brake.fmu").touch()
    shutil.copytree(ROOT / "sumo_nets" / "pedestrian_crossing", place / "own_road")
    for command, extra in EXTRAS.items():
        study = command.split()[1]
        for line in (command, f"check {study}") if "--" not in command else (command,):
            printed = machine.run(PROGRAM + line, "extras", (INPUT_ERROR,))
            lines = [
                text
                for text in printed.splitlines()
                if not text.startswith("warning: ")
            ]
            if len(lines) != 2 or f"pip install '.[{extra}]'" not in lines[1]:
                raise SystemExit(
                    f"{line}: two lines that name {extra}, but it prints\n{printed}"
                )


def main() -> None:
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        machine = Machine(Path(folder))
        (machine.folder / "readme").mkdir()
        read_me(machine)
        installed_files(machine)
        size = int(machine.run("du -sm env", ".").split()[0])
        pages(machine)
        extras(machine)
    print(f"{size} MiB, {time.monotonic() - begin:.0f} s")
    if size > MAX_DISK:
        raise SystemExit(f"the installation has more than {MAX_DISK} MiB")


if __name__ == "__main__":
    main()
