"""Pages as a code host shows them: links lead to files and headings, and nothing needs the site."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    ROOT / "cfjax" / "_xla" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
]


def source(page):
    """The Markdown of a page or of a notebook, without its code."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    text = re.sub(r"^( *)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "code", text)


def targets(page):
    return re.findall(r"\]\((?!https?:)([^)\s]+)\)", source(page))


def anchors(page):
    """The anchors of its headings, as GitHub and GitLab make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    shown = (re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in shown}


def test_links_and_pictures_lead_to_what_is_there(subtests):
    for page in PAGES:
        with subtests.test(page=str(page.relative_to(ROOT))):
            for target in targets(page):
                path, _, anchor = target.partition("#")
                found = (page.parent / path).resolve() if path else page
                assert found.is_relative_to(ROOT) and found.exists(), target
                assert not anchor or anchor in anchors(found), target


def test_nothing_needs_the_site(subtests):
    for page in PAGES:
        with subtests.test(page=str(page.relative_to(ROOT))):
            text = source(page)
            # References to the API, which only the site resolves; and its own math and attributes.
            assert re.findall(r"\]\[[^\]]*\]", text) == []
            own = re.findall(r"\\[(\[]|\{ ?[.:#]|^(?:!!!|\?\?\?)", text, flags=re.MULTILINE)
            assert own == []


def test_links_are_found():
    found = {str(page.relative_to(ROOT)): targets(page) for page in PAGES}
    assert "docs/getting_started.md" in found["README.md"]
    assert "faq.md#float32-and-float64" in found["docs/errors.md"]
    assert sum(map(len, found.values())) > 100
    assert {"nan", "max_steps", "dt0"} < anchors(ROOT / "docs" / "faq.md")


def test_pictures_of_the_gallery_are_results_of_notebooks():
    """`output_5_0.png` is the first result of the fifth cell, as nbconvert names it."""
    text = (ROOT / "docs" / "gallery.md").read_text()
    pictures = re.findall(r"<!-- picture: (\w+)/output_(\d+)_(\d+)\.png: .+ -->", text)
    assert len(pictures) >= 7
    for name, cell, result in pictures:
        cells = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text())["cells"]
        assert "image/png" in cells[int(cell)]["outputs"][int(result)]["data"], name
