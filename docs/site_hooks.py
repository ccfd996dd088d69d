"""Pages and links of the documentation site: the README in front, a reference page for each room.

Documents link to source files, which the site does not hold: a link to a function leads to its
entry in the reference, one to another file of the repository becomes its name.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "soup_nlp"
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)")
SLIDER = """

<div class="slider"><img src="gallery/street_depth.jpg" alt="depth of the street">
<img src="gallery/street_image.jpg" alt="image of the street">
<input type="range" min="0" max="100" aria-label="share of the image beside its depth"
 oninput="this.parentNode.style.setProperty('--at', this.value + '%')"></div>
"""
"""The reference image over its depth, below the moving picture; a slider uncovers either."""
NAME = re.compile(r"`([A-Za-z_][\w.]*)`")


def rooms() -> list[str]:
    """Folders of the package, and the modules beside them."""
    found = sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py"))
    return [*found, "arrays", "errors"]


def on_config(config: Any) -> Any:
    """Append the reference to the navigation."""
    config.nav = [*config.nav, {"Reference": [{room: f"reference/{room}.md"} for room in rooms()]}]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    readme = re.sub(r"\]\(docs/", "](", readme).replace("](results/", "](../results/")
    readme = readme.replace("](CITATION.cff)", "](../CITATION.cff)")
    readme = readme.replace("](CONTRIBUTING.md)", "](../CONTRIBUTING.md)")
    first = PICTURE.search(readme)
    assert first is not None
    readme = readme[: first.end()] + SLIDER + "\n" + readme[first.end() :].lstrip("\n")
    for link in PICTURE.findall(readme):
        picture = Path(link).name
        readme = readme.replace(f"]({link})", f"]({picture})")
        source = str(ROOT / "docs" / link)
        files.append(File.generated(config, picture, abs_src_path=source))
    files.append(File.generated(config, "index.md", content=readme))
    for room in rooms():
        text = f"::: soup_nlp.{room}\n"
        files.append(File.generated(config, f"reference/{room}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links to files of the repository into links of the site."""

    def replaced(match: re.Match[str]) -> str:
        bang, label, link = match.groups()
        if bang or "://" in link or files.get_file_from_path(link.partition("#")[0]):
            return match.group()
        if link.startswith("#"):
            return match.group()
        target = (ROOT / "docs" / link.partition("#")[0]).resolve()
        name = NAME.fullmatch(label)
        if target.suffix == ".py" and target.is_relative_to(PACKAGE) and name:
            module = target.relative_to(ROOT).with_suffix("").parts
            dotted = ".".join(part for part in module if part != "__init__")
            # the reference has no private functions and no constants without a docstring
            absent = name[1].isupper() or any(x.startswith("_") for x in name[1].split("."))
            anchor = dotted if absent else f"{dotted}.{name[1]}"
            return f"[{label}](reference/{module[1]}.md#{anchor})"
        return f"{label} (`{target.relative_to(ROOT)}`)"

    return LINK.sub(replaced, markdown)
