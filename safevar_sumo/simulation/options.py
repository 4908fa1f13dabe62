"""Which of SUMO's options a network's folder may set: none that writes a file, opens a socket or draws at random."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from safevar_sumo.errors import InputError

SECTIONS = ("configuration", "input", "time", "processing", "report", "gui_only", "random_number", "routing", "output")
LEGAL = re.compile(
    r"net-file|route-files|gui-settings-file|begin|step-length|step-method\.ballistic|lateral-resolution|seed|max-depart-delay"
    r"|(collision|intermodal-collision|pedestrian|default|time-to-teleport|emergencydecel)(\.[a-z-]+)+|time-to-teleport"
    r"|ignore-junction-blocker|ignore-accidents|no-internal-links|lanechange\.duration|no-warnings|no-step-log|verbose")
"""They say how vehicles and persons move, or which of the folder's own files are read."""


def check_options(file: Path) -> None:
    """Refuse a configuration with an option that is not on the list.

    Raises
    ------
    InputError
        Naming the file and the option.
    """
    try:
        root = ElementTree.parse(file).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(file, f"cannot be read: {error}", "a configuration of SUMO") from None
    for element in root.iter():
        name = str(element.tag)
        if name not in SECTIONS and not LEGAL.fullmatch(name):
            raise InputError(file, f"sets SUMO's option {name!r}", "options that write no file, open no socket and draw nothing at random, "
                             "such as step-length, collision.* and pedestrian.*")
