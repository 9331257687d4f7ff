"""Sphinx: `make docs` builds build/docs from this folder, with every warning an error."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import safeswitch

ROOT = Path(__file__).resolve().parents[1]

project = "SafeSwitch"
author = "SafeSwitch developers"
copyright = author
version = release = safeswitch.__version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"SafeSwitch {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_theme_options = {"navigation_with_keys": True}

# ---- API pages, from the docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "Bools", "Ints")}  # by name, not spelled out
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}  # each at its home
default_role = "code"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!safeswitch).*"),  # other projects' objects, and short names of type hints
    (r"py:.*", r"safeswitch.*\.([A-Z]|Annotated|Marks)"),  # type variables and aliases
]


_COLON = "\ue000"  # of the private use area: in no docstring


def _sentence(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Hide a colon in the sentence about an attribute from napoleon, which takes what is before it for the type."""
    if what in ("attribute", "data", "property") and lines:
        lines[0] = lines[0].replace(":", _COLON)


def _plain(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Escape what reStructuredText takes for markup in a docstring that is plain text, outside of literal text."""
    lines[:] = [line.replace(_COLON, ":") for line in lines]
    if any(line.startswith("## ") for line in lines):  # written in Markdown, with tables: shown as it is
        body = lines.index("") if "" in lines else len(lines)
        lines[body:] = ["", ".. code-block:: text", "", *(f"   {line}" for line in lines[body:]), ""]
        return
    if what == "module":
        lines[:] = _literal_blocks(lines)
    for i, line in enumerate(lines):
        field = re.match(r"\s*(:[^:]*:|\.\.|\* )?", line)
        start, rest = line[: field.end()], line[field.end() :]  # type: ignore[union-attr]
        if start.strip() == ".." or (what == "module" and line.startswith("    ")):
            continue
        parts = re.split(r"(``.*?``|`[^`]*`|:\w+:`[^`]*`)", rest)
        parts[::2] = [re.sub(r"([*|])|(?<=\w)(_)(?=\W|$)", r"\\\g<0>", part) for part in parts[::2]]
        for literal, after in zip(range(1, len(parts), 2), parts[2::2], strict=True):
            if re.match(r"\w", after):  # a plural such as `Panel`s
                parts[literal] += "\\ "
        lines[i] = start + "".join(parts)


def _literal_blocks(lines: list[str]) -> list[str]:
    """The same with `::` before blocks that are set off by an indentation: formulas and tables of modules."""
    found: list[str] = []
    for line in lines:
        last = next((each for each in reversed(found) if each.strip()), "")
        inside = last.startswith("    ") or last.rstrip().endswith("::") or last.startswith(("* ", "- "))
        if line.startswith("    ") and not inside and found and not found[-1].strip():
            found += ["::", ""]
        found.append(line)
    return found


def _outside(app: Any, docname: str, source: list[str]) -> None:
    """Links to files of the repository that are no pages of this site become names: the site works by itself."""
    included = {
        "../CONTRIBUTING.md": "contributing.md",
        "../CHANGELOG.md": "changelog.md",
        "../assets/README.md": "assets.md",
    }

    def link(match: re.Match[str]) -> str:
        text, target = match[1], match[2]
        if "://" in target or target.startswith("#"):
            return match[0]
        if docname in ("contributing", "changelog"):  # they stand a folder higher
            target = target.removeprefix("docs/") if target.startswith("docs/") else f"../{target}"
        if target in included:
            return f"[{text}]({included[target]})"
        if target.startswith("../"):
            return f"{text} (`{target.removeprefix('../')}` in the repository)"
        return f"[{text}]({target})"

    if docname == "index":  # patterns for pages that not every version has
        lines = source[0].splitlines(keepends=True)
        source[0] = "".join(line for line in lines if not re.fullmatch(r"\w+\*\n", line) or _matches(line.strip()))
    source[0] = re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", link, source[0])


def _write_api(app: Any) -> None:
    """One page a module below docs/api, which git ignores: every module is there without being listed anywhere."""
    folder, pages = Path(__file__).parent / "api", {}
    for root in (ROOT / "benchmark" / "safeswitch", ROOT / "baselines" / "safeswitch_baselines"):
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root.parent).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            if not parts[-1].startswith("__main__"):
                pages[name] = path
    for name in pages:
        below = [each for each in pages if each.rpartition(".")[0] == name]
        lines = [f"# {name}", "", "```{eval-rst}", f".. automodule:: {name}", "```", ""]
        if below:
            lines += ["## Modules", "", *(f"* [{each}]({each}.md): {_summary(pages[each])}" for each in below), ""]
            lines += ["```{toctree}", ":hidden:", "", *below, "```", ""]
        page, text = folder / f"{name}.md", "\n".join(lines)
        if not page.exists() or page.read_text() != text:  # unchanged pages are not read again
            folder.mkdir(exist_ok=True)
            page.write_text(text)
    for stale in set(folder.glob("*")) - {folder / f"{name}.md" for name in pages}:
        stale.unlink()


def _summary(path: Path) -> str:
    return (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0].replace("*", "\\*")


def _matches(pattern: str) -> bool:
    return any(Path(__file__).parent.glob(f"{pattern}.md"))


def setup(app: Any) -> None:
    """Hooks of this site."""
    app.connect("builder-inited", _write_api)
    app.connect("autodoc-process-docstring", _sentence, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", _plain, priority=900)  # and after it
    app.connect("source-read", _outside)
    app.connect("include-read", lambda app, relative, parent, content: _outside(app, parent, content))
