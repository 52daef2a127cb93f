"""Small files that are right, and what may happen to them."""

from __future__ import annotations

from hypothesis import strategies as st

VALID = {
    "fuzz.obj": b"# c\no a\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1e-3 0 0 0 1\nv -1 .5 2 0 0 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    b"vn 0 0 1\ng b\nf 1/1/1 2/2/1 3/3/1\nusemtl m\nf -4/-3/-1 -2/-1/-1 -1/-2/-1\n",
    "regular.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 3/3 2/2 1/1\n",
    "fuzz.off": b"OFF\n# c\n4 2 0\n0 0 0\n1 0 0\n0 1e-3 0\n-1 .5 2\n3 0 1 2 255 0 0\n3 0 2 3\n",
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
    """Bytes of a file replaced, removed, repeated or put in."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.integers(0, 8)))
        data = data[:start] + draw(splices) + data[stop:]
    return data
