"""The examples of a page: code, what it prints, and the pictures that it draws.

The blocks of a section, and all blocks of a tutorial, share their names. Three kinds of blocks belong to an example:

```python
print(1 + 1)  # prints 2
print(1 / 3)
```

```output
0.333…
```

```{picture} file.png What the picture shows
save("file.png")
```

A comment ``# prints …`` states the output of its line, and the block ``output`` that of all other lines of the block
before it. A picture is a PNG file that the code above it writes, or the code in its block, which the page does not
show. When the documentation is built, an image takes its place.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from PIL import Image

if TYPE_CHECKING:
    from sphinx.application import Sphinx

#: Pictures of pages, in the folder of the sources.
FOLDER = "_pictures"
KINDS = "python", "output", "{picture}"
#: The largest width and height of a picture, in pixels.
SIZE = 800, 800

# A line that begins with # is a comment in a block, and a heading outside.
_HEADING_OR_BLOCK = re.compile(r"^#+ ([^\n]*)$|^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PICTURE = re.compile(r"^```\{picture\} (\S+) ([^\n]*)\n.*?^```$", re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """A block of an example: one of ``KINDS``, the words after it, and its text."""

    kind: str
    words: str
    text: str


def sections(text: str, *, whole: bool) -> list[tuple[str, list[Block]]]:
    """Return the title and the blocks of each section; of a ``whole`` page, which is one section, without title."""
    found: list[tuple[str, list[Block]]] = [("", [])]
    for heading, info, body in _HEADING_OR_BLOCK.findall(text):
        kind, _, words = info.partition(" ")
        if heading and not whole:
            found.append((heading, []))
        elif kind in KINDS:
            found[-1][1].append(Block(kind, words, body))
    return [(title, blocks) for title, blocks in found if blocks]


def run(blocks: list[Block], printed: Callable[[int, int, str], object]) -> None:
    """Run the code of a section, and call ``printed(block, line, text)`` for each print, lines counted from 0."""

    def record(*values: object) -> None:
        frame = sys._getframe(1)
        printed(int(frame.f_code.co_filename.removeprefix("block ")), frame.f_lineno - 1, " ".join(map(str, values)))

    names: dict[str, Any] = {"__name__": "example", "print": record}
    for number, block in enumerate(blocks):
        if block.kind != "output":
            exec(compile(block.text, f"block {number}", "exec"), names)


def store(picture: Path, folder: Path) -> Path:
    """Write a picture as small as pages show it into a folder, and return its path."""
    with Image.open(picture) as image:
        small = image.convert("RGB")
    small.thumbnail(SIZE, Image.Resampling.LANCZOS)
    small.quantize(200, Image.Quantize.MAXCOVERAGE, kmeans=3).save(folder / picture.name, optimize=True)
    return folder / picture.name


def _draw(app: Sphinx, page: str, source: list[str]) -> None:
    """Draw the pictures of a page, and put images in place of their blocks."""
    for _, blocks in sections(source[0], whole=page.startswith("tutorials/")):
        pictures = [block.words.split()[0] for block in blocks if block.kind == "{picture}"]
        if pictures:
            folder = Path(app.srcdir, FOLDER, page)
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory() as work, chdir(work):
                run(blocks, lambda *_: None)
                for picture in pictures:
                    store(Path(picture), folder)
    source[0] = _PICTURE.sub(rf"![\2](/{FOLDER}/{page}/\1)", source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("source-read", _draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
