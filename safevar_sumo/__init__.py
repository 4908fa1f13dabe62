"""SafeVar on SUMO: which smallest variations of a vehicle make its automated driving system unsafe?

`import safevar_sumo as sv`, and then `sv.simulate("rain", {"tireFric": 1.1})`. `__init__.pyi` lists
all public names; each is loaded on first use, so importing the package is fast.
"""

import logging
from typing import Any

import lazy_loader

# The package logs in silence until a program adds a handler.
logging.getLogger(__name__).addHandler(logging.NullHandler())
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # `importlib.metadata` imports modules that a file in the working directory could replace.
        # Therefore it is imported only when it is needed.
        from importlib.metadata import version

        return version(__name__)
    return _load(name)
