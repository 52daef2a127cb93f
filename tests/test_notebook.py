"""The README's example as a notebook: the same code, and figures that appear in a new kernel."""

from __future__ import annotations

import ast
import base64
import json
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parent.parent
NOTEBOOK = ROOT / "examples" / "readme.ipynb"


def cells(kind):
    return [
        "".join(cell["source"])
        for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
        if cell["cell_type"] == kind
    ]


def test_the_code_is_that_of_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    example = re.search(r"^## In Python\n\n```python\n(.*?)^```", readme, re.MULTILINE | re.DOTALL).group(1)
    code = cells("code")
    # Equal except for the positions of comments, which the formatter changes.
    assert ast.dump(ast.parse(code[0])) == ast.dump(ast.parse(example))
    assert "result" in code
    assert all(
        "outputs" not in cell or not cell["outputs"] for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    )


@pytest.mark.long
def test_figures_appear_in_a_new_kernel(tmp_path):
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    import nbformat  # which the client brings

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert "strictly positive, verified exactly" in code[0].outputs[0].text
    # Every other cell shows one picture, in the page of a result or as a figure.
    assert len(code) > 4
    for cell in code[1:]:
        (output,) = cell.outputs
        data = output.data.get("image/png") or re.search(
            r"data:image/png;base64,([^\"]+)", output.data["text/html"]
        ).group(1)
        assert np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("L")).std() > 5
        assert len(output.data["text/plain"]) < 200
