"""Run a notebook of examples/ and write its page of the documentation: text, code, output, figures.

python tools/render_notebook.py      (hidden_payload.ipynb)

The notebook itself is committed without outputs. A test compares the page's code with the notebook's.
"""

from __future__ import annotations

import argparse
import base64
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorials" / "hidden-payload.md"
NOTEBOOK = ROOT / "examples" / "hidden_payload.ipynb"
HEAD = """\
<!-- Made by python tools/render_notebook.py from examples/{notebook}. -->
"""


def run(notebook: Path) -> Any:
    """Return the notebook with its outputs."""
    # Not above: a test of the page's code loads this file and runs nothing.
    import nbformat
    from nbclient import NotebookClient

    found = nbformat.read(notebook, as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(found, kernel_name="python3", timeout=300).execute()
    return found


def page_of(notebook: Any, name: str, images: Path) -> str:
    """Return the page, and write its figures.

    Args:
        notebook: The notebook, with its outputs.
        name: Its file's name.
        images: Folder of the figures, beside the page's folder.
    """
    title, *others = [part for cell in notebook.cells for part in parts(cell, Path(name).stem, images)]
    return "\n\n".join([title, HEAD.format(notebook=name).rstrip(), *others]) + "\n"


def parts(cell: Any, stem: str, images: Path) -> list[str]:
    """Return a cell's parts of the page: its text, or its code and what it shows."""
    if cell["cell_type"] == "markdown":
        return [cell["source"].strip()]
    found = [code_block(cell["source"])]
    for output in cell["outputs"]:
        data = output.get("data", {})
        if "image/png" in data:
            figure = images / f"{stem.replace('_', '-')}.png"
            figure.write_bytes(base64.b64decode(data["image/png"]))
            found.append(f"![What the last cell draws](../{images.name}/{figure.name})")
        elif "text/html" in data:
            found.append(data["text/html"].strip())
        else:
            found.append(f"```text\n{output.get('text') or data['text/plain']}".rstrip() + "\n```")
    return found


def code_block(source: str) -> str:
    """Return a code cell as a block of the page."""
    return f"```python\n{source.strip()}\n```"


def main() -> None:
    """Run the notebook and write the page."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    text = page_of(run(NOTEBOOK), NOTEBOOK.name, ROOT / "docs" / "images")
    PAGE.write_text(text, encoding="utf-8")
    print(f"written: {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
