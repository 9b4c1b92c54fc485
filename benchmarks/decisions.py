"""Which field and which method: the pages' tables, from `docs/decisions.toml`."""

import posixpath
import re
import tomllib
from pathlib import Path

SOURCE = tomllib.loads(
    (Path(__file__).parents[1] / "docs" / "decisions.toml").read_text(encoding="utf-8")
)
METHODS = {decision["name"]: decision["method"] for decision in SOURCE["decision"]}


def rows(name: str) -> list[list[str]]:
    """The heading and the rows of a table, as cells. Links are relative to `docs/`."""
    return TABLES[name]()


def methods() -> list[list[str]]:
    """All decisions."""
    table = [["your problem", "use", "because"]]
    return table + [[d["problem"], _use(d), d["why"]] for d in SOURCE["decision"]]


def reasons() -> list[list[str]]:
    """The decisions that most readers need, with their reasons."""
    short = (d for d in SOURCE["decision"] if "short" in d)
    table = [["your problem", "use", "because"]]
    return table + [[d["short"], _use(d), d["why"]] for d in short]


def first() -> list[list[str]]:
    """The same without reasons, with a link."""
    short = (d for d in SOURCE["decision"] if "short" in d)
    table = [["your problem", "method to try first", ""]]
    return table + [[d["short"], _use(d), f"[more]({d['page']})"] for d in short]


def states() -> list[list[str]]:
    table = [["your state", "shape", "return", "method", "page"]]
    return table + [
        [s["state"], s["shape"], s["fields"], _method(s), f"[{s['title']}]({s['page']})"]
        for s in SOURCE["state"]
    ]


def fields() -> list[list[str]]:
    table = [["return", "acts on", "as", "method"]]
    return table + [[f["call"], f["acts"], f["as"], _method(f)] for f in SOURCE["field"]]


TABLES = {
    "methods": methods,
    "reasons": reasons,
    "first": first,
    "states": states,
    "fields": fields,
}


def relocated(text: str, folder: str) -> str:
    """The text with its links to pages relative to a folder of the repository."""

    def link(match: re.Match[str]) -> str:
        path, anchor, rest = match[1].partition("#")
        return f"]({posixpath.relpath(f'docs/{path}', folder)}{anchor}{rest})"

    return re.sub(r"\]\(([^)]+)\)", link, text)


def _use(decision: dict[str, str]) -> str:
    adaptive = decision.get("adaptive")
    return decision["method"] + (f"; with adaptive steps {adaptive}" if adaptive else "")


def _method(row: dict[str, str]) -> str:
    return row["method"].format_map(METHODS)
