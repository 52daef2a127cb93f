import copy
import json
import tempfile
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from quasiharmonic import io
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.formats import obj as obj_module
from quasiharmonic.io.formats import off as off_module
from quasiharmonic.io.formats.objlines import read_obj_lines
from shared.damaged_files import VALID, damaged
from shared.examples import examples
from shared.gltf_files import SQUARE, square

quick = examples(60)


pytestmark = pytest.mark.long


def held(mesh):
    """Return all data of a mesh, comparable to the last bit."""

    def plain(a):
        if a is None:
            return None
        a = np.ascontiguousarray(a)
        assert a.dtype in (np.float64, np.int64)
        return a.shape, a.tobytes()

    arrays = (mesh.V, mesh.F, mesh.vt, mesh.FT, mesh.extra, mesh.FN, mesh.statement_faces)
    return [*map(plain, arrays), mesh.normals, mesh.statements]


def outcome(read, *args):
    """Return what a reader makes of its input: a mesh or an error of this package; other errors propagate."""
    try:
        return held(read(*args))
    except MeshFileError as error:
        return str(error)


def read_back(data, name):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        try:
            mesh = io.read_mesh(path)
        except MeshFileError as error:
            str(error).encode()
            return
        # Accepted input can be written and is read back unchanged.
        io.write_obj(path.with_suffix(".obj"), mesh)
        again = io.read_mesh(path.with_suffix(".obj"))
        assert held(again) == held(mesh)


# Files that are almost valid, for which two readers might differ.

numbers = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-9, 9).map(str),
    st.sampled_from(
        ["1.", ".5", "+1", "-0", "1E3", "1e-320", "1e999", "nan", "inf", "1_0", "1e", ".", "-", "+-1", "1d2", "x"]
    ),
)
plain_numbers = st.integers(-9, 9).map(str)
gaps = st.sampled_from([" ", " ", " ", " ", "  ", "\t", "\x0b", " \\\n"])
ends = st.sampled_from(["\n", "\n", "\n", "\n", " \n", "\r\n", "\n\n", " # c\n", "\\\n", "\n "])
statements = st.sampled_from(
    ["# c", "# c\\", "g a", "o b c ", "usemtl é", "s off", "l 1 2", "l 1/1 2/2", "p -1", "vp 1", "vx 1", "fo 1 2 3"]
)


@st.composite
def obj_texts(draw):
    tidy = draw(st.booleans())
    number = plain_numbers if tidy else numbers
    gap = st.just(" ") if tidy else gaps
    end = st.just("\n") if tidy else ends

    def line(keyword, words):
        return keyword + "".join(draw(gap) + word for word in words) + draw(end)

    vertices, places, normals = draw(st.integers(1, 6)), draw(st.integers(0, 3)), draw(st.integers(0, 2))
    width = draw(st.sampled_from([3, 3, 3, 4, 6, 2]))
    form = draw(st.sampled_from(["a", "a/b", "a//c", "a/b/c"]))
    lines = [line("v", [draw(number) for _ in range(width)]) for _ in range(vertices)]
    lines += [
        line("vt", [draw(number) for _ in range(draw(st.sampled_from([2, 2, 3]) if not tidy else st.just(2)))])
        for _ in range(places)
    ]
    lines += [line("vn", [draw(number) for _ in range(3)]) for _ in range(normals)]

    def index(count):
        return str(draw(st.integers(1, max(count, 1)) if tidy else st.integers(-count - 1, count + 1)))

    for _ in range(draw(st.integers(1, 5))):
        shape = form if tidy else draw(st.sampled_from([form, form, form, "a", "a/b", "a/", "a/b/", "/b", "a/b/c/"]))
        corners = draw(st.sampled_from([3] if tidy else [3, 3, 3, 3, 2, 4]))
        words = [
            shape.replace("a", index(vertices)).replace("b", index(places)).replace("c", index(normals))
            for _ in range(corners)
        ]
        lines.append(line("f", words))
    for _ in range(draw(st.integers(0, 4))):
        text = draw(statements.filter(lambda s: s[0] in "#gousv") if tidy else statements)
        lines.insert(draw(st.integers(0, len(lines))), text + "\n")
    if draw(st.booleans()):
        lines = draw(st.permutations(lines))
    return "".join(lines).replace("\r\n", "\n").encode()


@quick
@given(obj_texts())
def test_both_obj_readers_agree(data):
    data += b"" if data.endswith(b"\n") else b"\n"
    regular = obj_module.read_regular("x", data)
    event("regular" if regular is not None else "irregular")
    careful = outcome(read_obj_lines, "x", data)
    if regular is not None:
        assert held(regular) == careful


@quick
@given(obj_texts())
def test_obj_is_read_back_unchanged(data):
    read_back(data, "fuzz.obj")


@st.composite
def off_texts(draw):
    tidy = draw(st.booleans())
    number = plain_numbers if tidy else numbers
    gap = st.just(" ") if tidy else gaps.filter(lambda g: "\\" not in g)
    end = st.just("\n") if tidy else st.sampled_from(["\n", "\n", " \n", "\n\n", "# c\n"])

    def line(words):
        return "".join(word + draw(gap) for word in words)[:-1] + draw(end)

    vertices, faces = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    wrong = 0 if tidy else draw(st.sampled_from([0, 0, 0, 1, -1]))
    text = "OFF" + draw(st.sampled_from(["\n", " ", "\n# c\n"])) + f"{vertices + wrong} {faces} 0\n"
    width = draw(st.sampled_from([3, 3, 4, 7, 2]))
    for _ in range(vertices):
        text += line([draw(number) for _ in range(width)])
    for _ in range(faces):
        corners = [str(draw(st.integers(0 if tidy else -1, vertices - tidy))) for _ in range(3)]
        text += line([draw(st.sampled_from(["3"] if tidy else ["3", "3", "3", "03", "4"])), *corners])
    return text.encode()


@quick
@given(off_texts())
def test_both_off_readers_agree(data):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder) / "fuzz.off"
        path.write_bytes(data)
        either = outcome(io.read_off, path)
        patch.setattr(off_module, "read_regular", lambda *args: None)
        assert outcome(io.read_off, path) == either


@pytest.mark.parametrize("name", VALID)
@quick
@given(data=st.data())
def test_damaged_files(name, data):
    text = data.draw(damaged(VALID[name]))
    if name != "handles.txt":
        read_back(text, name)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(text)
        try:
            handles = io.read_handles(path, 4)
        except MeshFileError:
            return
    assert len(np.unique(handles)) == len(handles) > 0
    assert 0 <= handles.min() <= handles.max() < 4


def branches(node, path=()):
    """Yield the positions of the values in a document."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from branches(value, (*path, key))


odd_values = st.one_of(
    st.sampled_from([None, True, "", "x", [], {}, [0], [1] * 16, 1e999, "data:,x", "VEC4", "MAT4", 5121, 5125]),
    st.integers(-2, 7),
    st.integers(10**9, 10**20),
)


@quick
@given(data=st.data())
def test_odd_documents(data):
    """A glTF file with invalid values is rejected or can be written again."""
    made = square(TEXCOORD_0=SQUARE[:, :2], NORMAL=SQUARE)
    made.tree |= {"nodes": [{"mesh": 0, "scale": [1, 2, 3]}], "scenes": [{"nodes": [0]}], "images": [{"uri": "a.png"}]}
    made.tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": made.accessor(SQUARE)}]
    tree = json.loads(made.gltf())
    for _ in range(data.draw(st.integers(1, 2))):
        *above, last = data.draw(st.sampled_from(sorted(branches(tree), key=str)))
        reduce(lambda node, key: node[key], above, tree)[last] = copy.deepcopy(data.draw(odd_values))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "odd.gltf"
        path.write_text(json.dumps(tree))
        try:
            mesh = io.read_mesh(path)
        except MeshFileError as error:
            str(error).encode()
            return
        torn = np.arange(mesh.F.size).reshape(-1, 3)
        io.write_mapped(path, replace(mesh, vt=np.arange(2.0 * mesh.F.size).reshape(-1, 2), FT=torn))
        np.testing.assert_array_equal(io.read_mesh(path).F, mesh.F)


@pytest.mark.parametrize("name", ["fuzz.obj", "fuzz.off", "fuzz.ply", "fuzz.glb", "fuzz.stl"])
@quick
@given(data=st.binary(max_size=200))
def test_arbitrary_bytes(name, data):
    read_back(data, name)
    read_back(b"OFF\n" + data, name)
