"""What pdflatex would stumble over, found without it: for machines that have no TeX."""

from __future__ import annotations

import re


def mistakes(document: str) -> list[str]:
    """Unbalanced groups and environments, rows of the wrong width, characters that are not escaped."""
    found = []
    depth = 0
    for sign in re.sub(r"\\[\\{}]", "", document):
        depth += (sign == "{") - (sign == "}")
        if depth < 0:
            break
    if depth:
        found.append("braces are not balanced")
    stack = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", document):
        if kind == "begin":
            stack.append(name)
        elif not stack or stack.pop() != name:
            found.append(f"\\end{{{name}}} closes nothing")
    if stack:
        found.append(f"{stack} never end")
    for columns, body in re.findall(r"\\begin\{tabular\}\{([lr]+)\}\n(.*?)\\end\{tabular\}", document, re.DOTALL):
        for row in [line for line in body.splitlines() if line.endswith(r"\\")]:
            spanned = sum(int(number) - 1 for number in re.findall(r"\\multicolumn\{(\d+)\}", row))
            cells = len(re.split(r"(?<!\\)&", row)) + spanned
            if cells != len(columns):
                found.append(f"{cells} cells in {len(columns)} columns: {row}")
            if re.match(r"[\[*]", row):
                found.append(f"taken for an option of the row before: {row}")
    for line in document.splitlines():
        if line.startswith("%"):
            continue
        plain = re.sub(r"\\[\\{}$&#%_]", "", line.removesuffix("%"))
        if re.search(r"[$#%~^_]", plain) or not line.isprintable():
            found.append(f"a character that is not escaped: {line}")
        if any(ord(sign) > 0x17E for sign in line):
            found.append(f"a character that the fonts lack: {line}")
    return found
