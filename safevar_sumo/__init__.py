"""SafeVar on SUMO: which smallest variations of a vehicle make its automated driving system unsafe?

`import safevar_sumo as sv`, and then `sv.simulate("rain", {"tireFric": 1.1})`. `__init__.pyi` lists all public names; each is
loaded on first use, so importing the package is fast.
"""

from importlib.metadata import version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version("safevar_sumo")
