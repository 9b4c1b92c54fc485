"""No measured number is typed in: times, sizes and ratios on pages come from stored results."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
# A page, or the source of tables on several of them.
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "docs").glob("*.toml")),
]

# What may have any numbers: written by `benchmarks/pages.py`, code, formulas and addresses.
ELSEWHERE = re.compile(
    r"<!-- (?:table|number): [\w-]+ -->.*?<!-- end -->|^ *```.*?^ *```|\$`.*?`\$|`[^`\n]+`"
    r"|\]\([^)]*\)|<!--.*?-->",
    flags=re.DOTALL | re.MULTILINE,
)
WORDS = "two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|twenty|a hundred|a thousand"
AMOUNT = rf"(?:\d(?:[\d.,]|(?<=\d) (?=\d\d\d))*(?:e-?\d+)?|{WORDS})"
RANGE = rf"(?<![\w.])(?:{AMOUNT}(?: to | or | and ))?{AMOUNT}"
TIME = r"[nmµ]?s|(?:nano|micro|milli)?seconds?|minutes?|hours?|days?"
MEMORY = r"[kKMG]i?B|(?:kilo|mega|giga)?bytes?"
COMPARED = (
    "as|longer|shorter|faster|slower|cheaper|dearer|larger|smaller|higher|lower|more|less|fewer"
)
COST = "time|times|memory|cost|work|steps|evaluations|operations|error|code"
PART = "half|a half|a third|a quarter|a fourth|a fifth|a ninth|a tenth|a hundredth"
MEASURED = re.compile(
    "|".join(
        [
            rf"(?:{RANGE} |\d)(?:{TIME}|{MEMORY}|%|per cent|percent)(?!\w)",
            rf"{RANGE} times (?:{COMPARED}|(?:the|its|their) (?:{COST}))\b",
            # Instants are times too: "at 20 times".
            rf"(?<!at ){RANGE} times(?=[.,;:)])",
            rf"\btwice (?:{COMPARED}|(?:the|its|their) (?:{COST}))\b",
            rf"\b(?:{PART})(?: of)? (?:the|its|their|that) (?:{COST})\b",
            r"\bhalf as (?:long|large|much|many|fast)\b",
        ]
    ),
    flags=re.IGNORECASE,
)

# Facts, which no machine changes.
FACTS = {
    "five minutes": "the time to read a page",
    "five nanoseconds": "the length of a pulse",
    "20 seconds": "the default of an option",
    "20 times as": "the ratio of two diffusivities, in the equation",
    "three times the evaluations": "step doubling makes three steps for one",
    "1 %": "the second moment of an angle, by a formula",
}


def prose(text):
    """The text with its lines, without what may have any numbers."""
    return ELSEWHERE.sub(lambda match: "\n" * match[0].count("\n"), text)


def found(text):
    """What looks measured, with its line."""
    return [
        (line, match[0])
        for line, words in enumerate(prose(text).splitlines(), 1)
        for match in MEASURED.finditer(words)
    ]


def test_no_measured_number_is_typed_in():
    typed = [
        f"{page.relative_to(ROOT)}:{line}: {words}"
        for page in PAGES
        for line, words in found(page.read_text(encoding="utf-8"))
        if words not in FACTS
    ]
    assert not typed, "Make it a marker of benchmarks/pages.py, or say it without a number."


def test_facts_are_on_the_pages():
    words = {words for page in PAGES for _, words in found(page.read_text(encoding="utf-8"))}
    assert set(FACTS) <= words


SEEN = [
    "It compiles in 14 s of processor time.",
    "a step of 3.5 µs",
    "7 to 8 s with both",
    "It takes two to three times as long.",
    "a solve of some 10 000 ms",
    "5 to 30 times faster",
    "in a tenth of the memory",
    "twice as fast",
    "Half the time is compilation.",
    "for some 40 % more time",
    "| 1.5 GiB | 64 bytes |",
    "in about half of the time",
    "with `CF54` on a rigid body 12 times.",
]
NOT_SEEN = [
    "It takes <!-- number: first-line -->8.9<!-- end --> s.",
    "```bash\nsleep 14 s\n```",
    "The rate is $`2 s`$, and `5 s` is code.",
    "See [Speed](speed.md#10-s).",
    "momenta at 20 times.",
    "the 2-norm of order 5, in 100 steps",
    "photons in threes",
    "several times as long",
]


def test_measured_numbers_are_seen_and_others_are_not():
    assert [text for text in SEEN if not found(text)] == []
    assert [text for text in NOT_SEEN if found(text)] == []
