"""Extension of mkdocstrings, which reads the code without running it: docstrings that are whole only once they are
imported.
"""

from __future__ import annotations

import inspect
from typing import Any

from griffe import Extension, dynamic_import


class WholeDocstrings(Extension):
    """Documents functions by the docstrings that they have once imported: questions complete theirs with their
    options.
    """

    def on_function(self, *, func: Any, **_: Any) -> None:
        if func.docstring and any("document_options(" in str(one.value) for one in func.decorators):
            func.docstring.value = inspect.getdoc(dynamic_import(func.path)) or ""
