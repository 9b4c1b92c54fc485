"""What the site takes from elsewhere in the repository, its links and math, and links to the API.

A page is written as a code host shows it: links lead to files of the repository, and math is as
GitHub and GitLab have it. Here these become links between pages, and MathML.
"""

import html
import posixpath
import re
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

import cfjax

ROOT = Path(__file__).parents[2]
PAGES = {
    "architecture.md": "ARCHITECTURE.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "xla.md": "cfjax/_xla/README.md",
}
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CHARTS = [*ROOT.glob("benchmarks/*.png"), *ROOT.glob("benchmarks/charts/*.png")]
DOCS = [str(path.relative_to(ROOT / "docs")) for path in ROOT.glob("docs/**/*.md")]
# Files of the repository, and where they are on the site.
PLACES = (
    {source: place for place, source in PAGES.items()}
    | {f"docs/{place}": place for place in DOCS}
    | {str(path.relative_to(ROOT)): str(path.relative_to(ROOT)) for path in CHARTS}
    | {f"notebooks/{path.name}": f"notebooks/{path.stem}.md" for path in NOTEBOOKS}
)
SOURCES = {place: source for source, place in PLACES.items()}


def on_config(config):
    titles = [{title(path): f"notebooks/{path.stem}.md"} for path in NOTEBOOKS]
    (recipes,) = (entry["Recipes"] for entry in config.nav if "Recipes" in entry)
    (gallery,) = (e["Gallery"] for e in recipes if isinstance(e, dict) and "Gallery" in e)
    gallery.extend(entry for entry in titles if entry not in gallery)
    return config


def on_files(files, *, config):
    def add(place, **source):
        files.append(File.generated(config, place, **source))

    for chart in CHARTS:
        add(str(chart.relative_to(ROOT)), abs_src_path=str(chart))
    for place, source in PAGES.items():
        add(place, content=(ROOT / source).read_text())
    for path in NOTEBOOKS:
        # With the results that are stored: nothing is run here.
        text, resources = MarkdownExporter().from_notebook_node(nbformat.read(path, as_version=4))
        for name, picture in resources["outputs"].items():
            text = text.replace(f"]({name})", f"]({path.stem}/{name})")
            add(f"notebooks/{path.stem}/{name}", content=picture)
        add(f"notebooks/{path.stem}.md", content=re.sub("\x1b\\[[0-9;]*m", "", text))
    return files


def title(path):
    cells = nbformat.read(path, as_version=4).cells
    return next(c.source for c in cells if c.source.startswith("# ")).splitlines()[0][2:]


def on_page_markdown(markdown, *, page, **_):
    place = page.file.src_uri
    # Diagrams would need a script from elsewhere.
    markdown = re.sub("```mermaid\n.*?```\n", "", markdown, flags=re.DOTALL)
    markdown = re.sub(r"```math\n(.*?)```", r"\\[\n\1\\]", markdown, flags=re.DOTALL)
    markdown = re.sub(r"\$`(.*?)`\$", r"\\(\1\\)", markdown)
    # The pictures of a notebook stand in it alone.
    markdown = re.sub(
        r"<!-- picture: ((\w+)/\w+\.png): (.*?) -->",
        r"[![\3](notebooks/\1)](notebooks/\2.md)",
        markdown,
    )
    return re.sub(r"\]\(([^)#\s]+)", lambda match: f"]({moved(match[1], place)}", markdown)


def moved(target, place):
    """A link of a page, from its file in the repository to the same from its place on the site."""
    folder = posixpath.dirname(SOURCES.get(place, place))
    found = PLACES.get(posixpath.normpath(posixpath.join(folder, target)))
    return posixpath.relpath(found, posixpath.dirname(place) or ".") if found else target


def on_page_content(content, **_):
    """Math as MathML, which browsers draw themselves, and names of the package as links."""

    def math(match):
        display, source = match[1] == "div", html.unescape(match[2].strip())
        inner = convert(source[2:-2], display="block" if display else "inline")
        return f'<{match[1]} class="math">{inner}</{match[1]}>'

    def link(match):
        name = match[1].removeprefix("cfjax.")
        # `flow` alone may be anything, `cfjax.flow` and `CF4` may not.
        module = getattr(getattr(cfjax, name, None), "__module__", "")
        known = module.startswith("cfjax") and (name != match[1] or name[0].isupper())
        call = f"<code>{match[1]}{match[2] or ''}</code>"
        return f'<autoref identifier="cfjax.{name}">{call}</autoref>' if known else call

    content = re.sub(r'<(span|div) class="arithmatex">(.*?)</\1>', math, content, flags=re.DOTALL)
    # Not within a link.
    return re.sub(r'(?<!">)<code>((?:cfjax\.)?[A-Za-z]\w*)(\(.*?\))?</code>', link, content)
