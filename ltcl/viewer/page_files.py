# SPDX-License-Identifier: BSD-3-Clause
"""Files of the page: as a server sends them, and as the one ES module of a widget.

The module of a widget is put together here, without other tools. Each file `name.js` becomes a
function that runs once and returns what the file exports:

    const gl_js = (() => { ...; return { Layers, draw }; })();
    const panel_js = (() => { const { draw } = gl_js; ...; return { Panel }; })();

That holds for the style of our own files: imports are named, each in a line of its own, and exports
stand before what they name.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

PAGE_FOLDER = Path(__file__).parent / "page"
SUFFIXES = (".html", ".css", ".js", ".svg")
# What the pages of server and widget have in common, and the line of index.html for it.
MARKUP = "viewer.html"
PLACE_OF_MARKUP = "<!-- viewer.html -->"
IMPORT = re.compile(r'^import \{ (.+) \} from "\./(\w+)\.js";$', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async function|function|class|const) (\w+))", re.MULTILINE)


def read_page() -> dict[str, bytes]:
    """Read all files of the page, by their names."""
    files = {}
    for file in PAGE_FOLDER.iterdir():
        if file.suffix in SUFFIXES:
            files[file.name] = file.read_bytes()
    markup = files.pop(MARKUP)
    files["index.html"] = files["index.html"].replace(PLACE_OF_MARKUP.encode(), markup)
    return files


def widget_module() -> str:
    """Return the ES module of a widget, with markup and style."""
    parts = [
        f"const MARKUP = {json.dumps(_text(MARKUP))};",
        f"const STYLE = {json.dumps(_text('page.css'))};",
    ]
    for name in _modules_before("widget"):
        parts.append(_as_function(name))
    parts.append("export default widget_js.widget(MARKUP, STYLE);")
    return "\n".join(parts) + "\n"


def _text(name: str) -> str:
    return (PAGE_FOLDER / name).read_text("utf-8")


def _modules_before(name: str) -> list[str]:
    """Return the names of all files that one imports, itself last, each after its own imports."""
    names: list[str] = []
    for _, imported in IMPORT.findall(_text(f"{name}.js")):
        for each in _modules_before(imported):
            if each not in names:
                names.append(each)
    return [*names, name]


def _as_function(name: str) -> str:
    """Return a file as a constant `name_js`, which has all that the file exports."""
    text = _text(f"{name}.js")
    exported = EXPORT.findall(text)
    body = EXPORT.sub("", IMPORT.sub(r"const { \1 } = \2_js;", text))
    return f"const {name}_js = (() => {{\n{body}return {{ {', '.join(exported)} }};\n}})();"
