"""How dense the package is to read; `python -m tests.reading` prints its densest files.

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
NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
    *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
}
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp
NESTED = COMPREHENSIONS | ast.IfExp | ast.Lambda
FIGURES = {
    "elements_a_line": ("elements", 1),
    "conditional_expressions_in_100_lines": ("conditional", 100),
    "comprehensions_in_100_lines": ("comprehension", 100),
    "nested_ones_in_100_lines": ("nested", 100),
    "function_words_in_1000_lines": ("word", 1000),
}
"""Figures: what is counted, and for how many lines."""


def has_nested(node: ast.AST) -> bool:
    """Whether an expression holds another one of its kinds."""
    return sum(isinstance(inner, NESTED) for inner in ast.walk(node)) > 1


def counts_in(source: str) -> Counter[str]:
    """What is counted in a module, and its lines of code."""
    tree = ast.parse(source)
    lines = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            lines |= {*range(token.start[0], token.end[0] + 1)}
    for docstring in take_docstrings(tree):
        lines -= {*range(docstring.lineno, (docstring.end_lineno or 0) + 1)}
    counts = Counter[str](line=len(lines))
    for node in ast.walk(tree):
        name = ""
        if isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        counts["elements"] += 1
        counts["conditional"] += isinstance(node, ast.IfExp)
        counts["comprehension"] += isinstance(node, COMPREHENSIONS)
        counts["nested"] += isinstance(node, NESTED) and has_nested(node)
        counts["word"] += name.strip("_") in FUNCTION_WORDS
    return counts


def figures_of(counts: Counter[str]) -> dict[str, float]:
    """The figures that `pyproject.toml` limits, by its keys."""
    lines = max(counts["line"], 1)
    return {name: per * counts[what] / lines for name, (what, per) in FIGURES.items()}


def reading() -> dict[str, float]:
    """The figures of the package."""
    return figures_of(sum(map(counts_in, sources_of("safevar_sumo").values()), Counter()))


if __name__ == "__main__":
    by_file = {path: counts_in(text) for path, text in sources_of("safevar_sumo").items()}
    densest = sorted(by_file, key=lambda path: -figures_of(by_file[path])["elements_a_line"])
    for path in densest[:20]:
        print(*(f"{figure:7.1f}" for figure in figures_of(by_file[path]).values()), path)
    for name, figure in reading().items():
        print(f"{figure:7.2f}  {name}")
