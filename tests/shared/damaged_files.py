"""Small valid files, and a strategy that damages them."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from shared.gltf_files import SQUARE, square

VALID = {
    "fuzz.obj": b"# c\no a\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1e-3 0 0 0 1\nv -1 .5 2 0 0 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    b"vn 0 0 1\ng b\nf 1/1/1 2/2/1 3/3/1\nusemtl m\nf -4/-3/-1 -2/-1/-1 -1/-2/-1\n",
    "regular.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 3/3 2/2 1/1\n",
    "fuzz.off": b"OFF\n# c\n4 2 0\n0 0 0\n1 0 0\n0 1e-3 0\n-1 .5 2\n3 0 1 2 255 0 0\n3 0 2 3\n",
    "fuzz.ply": b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty double y\nproperty float z\n"
    b"property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
    b"property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    b"0 0 0 9 9 9\n1 0 0 9 9 9\n1 1 0 9 9 9\n0 1 0 9 9 9\n3 0 1 2 6 0 0 1 0 1 1\n4 0 1 2 3 8 0 0 1 0 1 1 0 1\n",
    "binary.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    + SQUARE[:3].tobytes()
    + b"\3"
    + np.arange(3, dtype="<i4").tobytes()
    + b"\3"
    + np.arange(3, dtype="<i4").tobytes(),
    "fuzz.glb": square(TEXCOORD_0=SQUARE[:, :2], NORMAL=SQUARE, COLOR_0=SQUARE).glb(),
    "fuzz.gltf": square(TEXCOORD_0=SQUARE[:, :2]).gltf(),
    "fuzz.stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    b"endloop\nendfacet\nendsolid a\n",
    "binary.stl": b"\0" * 80 + b"\1\0\0\0" + b"\0" * 12 + SQUARE[:3].tobytes() + b"\0\0",
    "handles.txt": b"0\n3 # c\n\n2\n1\n",
}
splices = st.one_of(
    st.binary(max_size=6),
    st.sampled_from(
        [b"\0", b"\n", b"\r", b"/", b"\\\n", b"-", b"#", b"9" * 30, b"9" * 5000, b"v ", b"f 1 2 3\n", b"\xff"]
    ),
    st.sampled_from(
        [b"nan", b"inf", b"1e999", b"2147483648", b" ", b"\t", b"\xef\xbb\xbf", b"\x1f\x8b", b"_", b"\x1a"]
    ),
)


@st.composite
def damaged(draw, data):
    """A file's bytes with parts replaced, removed, repeated or inserted."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.integers(0, 8)))
        data = data[:start] + draw(splices) + data[stop:]
    return data
