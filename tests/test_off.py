"""OFF files are read exactly; an error names the line."""

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshData, MeshFileError
from shared.obj_files import SQUARE_F


@pytest.mark.parametrize(
    "text",
    [
        "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
        "OFF 4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3",
        "# c\nOFF\n# c\n\n4 2\n0 0 0\n1 0 0 # c\n\n1 1 0\n0 1 0\n3 0 1 2 # c\n3 0 2 3\n\n",
        "OFF\r\n4 2 0\r\n0 0 0\r\n1 0 0\r\n1 1 0\r\n0 1 0\r\n3 0 1 2\r\n3 0 2 3\r\n",
        "OFF\n4 2 0\n 0 0  0\n1\t0 0 \n1 1 0\n0 1 0\n3  0 1 2 255 0 0\n3 0 2 3 7\n",
        "COFF\n4 2 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n3 0 1 2\n3 0 2 3\n",
    ],
)
def test_off_files_are_read(put, text):
    mesh = io.read_mesh(put(text, "mesh.off"))
    assert mesh.V.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.F.tolist() == SQUARE_F


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' and not OFF at line 1"),
        ("4OFF\n1 1 0\n", "'4OFF' and not OFF at line 1"),
        ("OFF BINARY\n", "no counts of vertices and faces at line 1"),
        ("OFF\n", "no counts of vertices and faces at line 1"),
        ("OFF\n3\n", "no counts of vertices and faces at line 2"),
        ("OFF\nx 1 0\n", "no counts of vertices and faces: 'x' is not an integer at line 2"),
        ("OFF\n-1 1 0\n", "has -1 vertices and 1 faces at line 2"),
        ("OFF\n0 0 0\n", "has 0 vertices and 0 faces at line 2"),
        (f"OFF\n{10**30} 1 0\n", "far too large at line 2"),
        (f"OFF\n{10**17} {10**17} 0\n0 0 0\n", f"ends after 1 of {10**17} vertices and 0 of {10**17} faces"),
        ("OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "a vertex with fewer than three coordinates at line 4"),
        ("OFF\n3 1 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n", "'nan' is not a finite number at line 4"),
        (
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2 0\n",
            "face with 4 corners that uses a vertex twice at line 6; remove the rep",
        ),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "face of 3 corners lists only 2 at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "index 3, but the file has 3 vertices at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "index -1, but the file has 3 vertices at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 x\n", "'x' is not an integer at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 2\n", "more follows the 1 faces at line 7"),
    ],
)
def test_malformed_off_is_named_with_its_line(put, text, message):
    with pytest.raises(MeshFileError) as caught:
        io.read_mesh(put(text, "mesh.off"))
    assert message in str(caught.value)


def test_off_keeps_vertices_that_no_face_uses(tmp_path):
    mesh = MeshData(np.arange(12).reshape(4, 3), [[0, 1, 3]])
    io.write_map(tmp_path / "out.off", mesh, [[0, 0], [1, 0], [9, 9], [0, 1]])
    text = (tmp_path / "out.off").read_text()
    assert text == "OFF\n4 1 0\n0.0 0.0 0.0\n1.0 0.0 0.0\n9.0 9.0 0.0\n0.0 1.0 0.0\n3 0 1 3\n"
