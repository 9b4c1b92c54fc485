"""Every message of an error that cfjax raises, read from its sources."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = {
    "_[a-z]*.py": "Term, state and equal steps",
    "_fields/*.py": "Fields",
    "_solvers/*.py": "Methods",
    "_methods/*.py": "Tableaus",
    "_batch/*.py": "Batches",
    "_measure/*.py": "Measuring",
    "_numerics/*.py": "Numerics",
}
CHECKS = {"eqx.error_if", "with_case"}


def on_page_markdown(markdown, *, page, **_):
    if page.file.src_uri != "messages.md":
        return markdown
    return markdown.replace("<!-- messages -->", "\n\n".join(sections()))


def sections():
    for paths, title in FOLDERS.items():
        lines = [f"- *{kind}*: {escaped(text)}" for text, kind in messages(paths)]
        yield f"## {title}\n\n" + "\n".join(lines)


def escaped(text):
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", text)


def messages(paths):
    """Pairs of a message, with an ellipsis for what it inserts, and the kind of error."""
    trees = [ast.parse(path.read_text()) for path in sorted(ROOT.glob(f"cfjax/{paths}"))]
    found = dict.fromkeys(pair for tree in trees for pair in _raised(tree))
    return [(text, kind) for text, kind in found if any(map(str.isalpha, text))]


def _raised(tree):
    """As they are written, or as a name or a function of the same file has them."""
    sources = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            values = [n.value for n in ast.walk(node) if isinstance(n, ast.Return)]
            sources.setdefault(node.name, []).extend(values)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            sources.setdefault(node.targets[0].id, []).append(node.value)
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            kind, text = ast.unparse(node.exc.func), node.exc.args[0]
            kind = kind if kind.endswith("Error") else "as its cause"
        elif isinstance(node, ast.Call) and _is_check(node.func):
            kind, text = "at run time", node.args[-1]
        else:
            continue
        name = ast.unparse(text.func if isinstance(text, ast.Call) else text)
        for source in sources.get(name, [text]):
            yield template(source), kind


def _is_check(function):
    return ast.unparse(function) in CHECKS or getattr(function, "attr", None) in CHECKS


def template(node):
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(template, node.values))
    if isinstance(node, ast.ListComp):
        return template(node.elt)
    if isinstance(node, ast.BinOp):
        return template(node.left) + template(node.right)
    return "…"
