"""Rules for sentences that users read, as far as patterns can check them.

A reader sees one sentence, not the page: it begins with who does what, has one idea and at most 22
words, names things again instead of "it", and has one word for each thing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

MOST_WORDS = 22
LABELS = (
    r"^((Valid for|Tested|(Rough|Unsafe|Safe) means|Required wear|Criterion|Not simulated|Changed"
    r"|Remark|Note|Expected|Default|Next|More|Examples?|Rough answer|No verdict|DO NOT RELEASE"
    r"|RELEASE|DECIDE|warning|note|failed|expected|The price|Range|Bar): )+"
)
"""What may stand before a sentence."""
LISTS = "(Valid for|Not simulated|Changed|Required wear|Criterion|Bar|Range): "
"""What is a list as a whole."""
VERBS = (
    "is|are|was|were|has|have|had|can|could|may|might|must|will|would|does|do|did|collides?|keeps?"
    "|found|contains?|holds?|needs?|means|makes?|gives?|says?|shows?|takes?|begins?|fails?|causes?"
    "|counts?|drives?"
)
UNITS = r"\b\d[\d,.]*(?: ?%| (?:kg m\^2/s|km/h|m/s\^2|m/s|N m|mm|kg|ms|m|s|N)\b)"
SERIES = (
    r"(?<![\w^/.-])(?:[\w^/.-]+ ){0,3}[\w^/.-]+(?:, [\w^/.-]+(?:"
    r" [\w^/.-]+){0,3}){2,} (?:and|or) "
)
"""Three and more values, which count as one word."""


EVERYWHERE = {
    r"^(Of|Over|Among|Out of) (the |these |all )?[\dX]": "a count stands before its verb",
    r", of which\b|, of these\b|\bthereof\b": "a count stands before its verb",
    r"^(It|They|Them|Those|There|What(?=[^:]*$)|Who|Its|Their|He|His)\b(?!.*\?$)": (
        "no noun at the beginning"
    ),
    rf"^(This|These|Which|One|Each|Both|Some|Others) ({VERBS})\b(?!.*\?$)": "no noun beside it",
    r": (none|all|no)[.,;]|, (none|hardly any) (?!of\b)": "the verb is left out",
    r"\b(is|are|was|were) (decided|kept(?! in\b| for\b)|met|demanded|claimed)\b"
    r"|\bholds? there\b": "who acts?",
    r"\b(nearly all|hardly any|almost all|most of them|some of them|of them|a few of)\b": (
        "which number, of what?"
    ),
    r"\b[a-z]+[a-z\d]*[A-Z][A-Za-z_]*\b": "a key in a sentence",
}
"""What breaks rules, and why."""
OUTSIDE_BRACKETS = {
    r"\b[Ss]ettings?\b|\bfalsif\w*|\battack\w*|\bfits\b|\bADSs?\b|\b[Pp]romises?\b"
    r"|\bpreventab\w*|\bcalibrations?\b|\brandom (cars|vehicles)\b|\bdecision steps?\b"
    r"|\b[Uu]nsafe means(?!:)|\bOne of (the )?\d": "another word for a term",
    r", as (a|an|the(?! (study|paper))|it|they|all|their|its|this|that|he|you|no|not)\b"
    r"|\bbut for\b|\bhence\b|[\u2013\u2014]|(?<=[a-z)]) - ": "because, so, although",
    r"^(?!(Study|[Ww]arning: study) \S+: [^:]*: [^:]*$)[^(]*?: [^(:]*?: ": "a second colon",
}
"""What may stand within brackets."""
IN_LISTS = {
    rf"[\w%]; (?!may be repeated|or\b|and\b)\w.*\b({VERBS})\b": "a semicolon: two sentences",
    r"\bwhich\b.*\bwhich\b": "a second 'which': two sentences",
}
"""What may also stand in a list."""


def words_in(sentence: str) -> int:
    """The number of words that count: not brackets, commands, or a list behind a colon."""
    text = re.sub(r"\([^()]*\)|\[[^\[\]]*\]", " ", sentence)
    text = re.sub(UNITS, "X", re.sub(r"python3? -m .*", " ", text))
    beginning, colon, rest = text.partition(": ")
    if colon and not re.search(rf"\b({VERBS})\b", rest):
        text = beginning
    return len(re.findall(r"[\w%][\w'.,/^%-]*", re.sub(SERIES, "X ", text)))


def broken_rules(sentence: str) -> list[str]:
    """Why a sentence breaks rules."""
    bare = re.sub(LABELS, "", sentence)
    if bare != sentence:
        bare = bare[:1].upper() + bare[1:]
    # Quotes and commands keep keys, and brackets explain.
    text = re.sub(r'"[^"]*"|\[[^\]]*\]|python3? -m .*', "Q", bare)
    outside = re.sub(r" ?\((?:[^()]|\([^()]*\))*\)", "", text)
    reasons = [why for pattern, why in EVERYWHERE.items() if re.search(pattern, text)]
    rules = OUTSIDE_BRACKETS
    if not re.match(LISTS, sentence):
        rules = {**OUTSIDE_BRACKETS, **IN_LISTS}
        number = words_in(bare)
        reasons += [f"{number} words"] if number > MOST_WORDS else []
    return reasons + [
        why for pattern, why in rules.items() if re.search(pattern, outside)
    ]


def split(text: str) -> Iterator[str]:
    """The sentences of a paragraph: what ends with a full stop, or is long enough to be one."""
    text = re.sub(r"\s+", " ", text.replace(" / ", "\0")).strip()
    for part in re.split(r"(?<=[.!?…])[\"”)*]*\s+(?=[\"“(*]?[A-Z\dX])|\0", text):
        sentence = part.strip(" *")
        if len(sentence.split()) > 3 and not sentence.endswith("…"):
            yield sentence


def sentences_in(page: str) -> Iterator[str]:
    """The sentences of a page of Markdown: of its paragraphs, and of the cells of its tables."""
    text = re.sub(r"(?ms)^```.*?^```$|<!--.*?-->|\n{3,}", "\n\n", page)
    text = re.sub(
        r"!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^)]*\)", r"\1", text.replace("\\|", "¦")
    )
    text = re.sub(r"(?s)`[^`]*`|\$\$.*?\$\$|\$[^$\n]+\$", "X", text.replace("**", ""))
    for paragraph in re.split(r"\n\s*\n|\n(?=\s*(?:[-*>] |\d+\. |\||#))|\|", text):
        if not paragraph.strip().startswith("#"):
            yield from split(re.sub(r"^\s*([-*>] |\d+\. )+", "", paragraph))
