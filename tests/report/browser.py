"""A headless Chromium that keeps to itself, and axe-core to look at a page with."""

from __future__ import annotations

import os
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

REQUIRED = "SAFEVAR_BROWSER"
"""Set where a missing browser is a failure and no reason to skip: in CI."""
AXE = "axe-core@4.10.3"
OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--window-size=1400,900")


def program(*names: str) -> str:
    """The first of these programs that there is."""
    found = next((path for path in map(shutil.which, names) if path), None)
    if found is None and not os.environ.get(REQUIRED):
        pytest.skip(f"{names[0]} is not installed")
    assert found, f"none of {', '.join(names)} is installed"
    return found


def chromium(profile: Path) -> webdriver.Chrome:
    """A browser with a profile of its own, that takes down what its pages say and ask for."""
    options = webdriver.ChromeOptions()
    options.binary_location = program("chromium", "chromium-browser", "google-chrome")
    for one in (*OPTIONS, f"--user-data-dir={profile}"):
        options.add_argument(one)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options=options, service=Service(program("chromedriver")))


def resized(browser: webdriver.Chrome, width: int, scheme: str = "light") -> None:
    """Make it a screen of that width, in light or dark."""
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]})
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride",
                            {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500})


def axe_core(folder: Path) -> str:
    """The script of axe-core, from npm's registry."""
    done = subprocess.run([program("npm"), "pack", AXE, "--silent", "--pack-destination", str(folder)], capture_output=True, text=True,
                          check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    with tarfile.open(next(folder.glob("axe-core-*.tgz"))) as archive:
        member = archive.extractfile("package/axe.min.js")
        assert member is not None
        return member.read().decode()


def violations(browser: webdriver.Chrome, axe: str) -> list[dict[str, Any]]:
    """What axe-core finds in the page that is serious or critical."""
    browser.execute_script(axe)
    found = browser.execute_async_script("const done = arguments[0]; axe.run(document).then((found) => done(found.violations));")
    return [{"rule": one["id"], "where": [node["html"][:150] for node in one["nodes"][:3]]}
            for one in found if one["impact"] in ("serious", "critical")]
