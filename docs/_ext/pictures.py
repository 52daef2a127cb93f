"""Pictures that gallery scripts write into their folder, collected for their pages."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from sphinx_gallery.scrapers import figure_rst

#: Where scripts write by default, relative to their own folder.
FOLDER = "figures"


def picture_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Collect PNG and GIF files that a script has written; sphinx-gallery calls it after each block of code."""
    folder = Path(block_vars["src_file"]).parent / FOLDER
    found = []
    for picture in sorted([*folder.glob("*.png"), *folder.glob("*.gif")]):
        place = Path(next(block_vars["image_path_iterator"])).with_suffix(picture.suffix)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(picture, place)
        found.append(str(place))
    # One below the other: side by side, pictures of different shapes become too small to read.
    return "\n".join(figure_rst([picture], gallery_conf["src_dir"]) for picture in found)
