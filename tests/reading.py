"""How dense the package is to read; `python -m tests.reading` prints its figures.

Lines are those with code, without docstrings, comments and blank lines. A function word is a name
of a variable or a parameter that is no noun.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter

from tests.size import sources_of, take_docstrings

FUNCTION_WORDS = frozenset(
    """
    one ones two own each every other others another left right_one found met told
    kept meant given taken cast set_ known that this these those it its them there
    here what which who whose such same some any all_ all none no both either
    before after beyond within below above again still yet also just only more
    most less least fewer rest first last next following previous left_out asked
    wanted needed allowed tried done made said shown seen held lost away apart
    near far inner outer ahead behind drawn begun moved missing open_ whole
    """.split()  # noqa: SIM905
)
NO_CODE = "COMMENT NL NEWLINE INDENT DEDENT ENDMARKER".split()  # noqa: SIM905
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp
NESTED = COMPREHENSIONS | ast.IfExp | ast.Lambda
LINES_OF = {
    "elements": 1,
    "conditional": 100,
    "comprehension": 100,
    "nested": 100,
    "word": 1000,
}
"""What is counted, and in how many lines."""


def counts_in(source: str) -> Counter[str]:
    """What is counted in a module, and its lines of code."""
    tree = ast.parse(source)
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if tokenize.tok_name[token.type] not in NO_CODE:
            lines |= {*range(token.start[0], token.end[0] + 1)}
    for docstring in take_docstrings(tree):
        lines -= {*range(docstring.lineno, (docstring.end_lineno or 0) + 1)}
    counts = Counter(line=len(lines))
    for node in ast.walk(tree):
        name = ""
        if isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        counts["elements"] += 1
        counts["conditional"] += isinstance(node, ast.IfExp)
        counts["comprehension"] += isinstance(node, COMPREHENSIONS)
        if isinstance(node, NESTED):
            counts["nested"] += (
                sum(isinstance(inner, NESTED) for inner in ast.walk(node)) > 1
            )
        counts["word"] += name.strip("_") in FUNCTION_WORDS
    return counts


def reading() -> dict[str, float]:
    """The figures of the package that `pyproject.toml` limits, by its keys."""
    counts = sum(map(counts_in, sources_of("safevar_sumo").values()), Counter())
    return {name: per * counts[name] / counts["line"] for name, per in LINES_OF.items()}


if __name__ == "__main__":
    print(reading())
