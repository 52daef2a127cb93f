"""Data sets of models that `unwrap` gives texture coordinates: records, resume, archives, shards, report."""

from __future__ import annotations

import io as streams
import re
import signal
import subprocess
import sys
import tarfile
import time

import numpy as np
import pytest

from quasiharmonic import batch, io, unwrap
from quasiharmonic.surfaces import starfish
from quasiharmonic.ui.batch.results import read_results
from shared.commands import linux, run
from shared.datasets import record_of
from shared.gltf_files import square, touching_squares

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]

V, F = starfish(2, 4)


@pytest.fixture
def models(tmp_path):
    """A clean model, one with a repeated and a reversed triangle, one without area, and one that is no mesh."""
    folder = tmp_path / "set"
    (folder / "sub").mkdir(parents=True)
    io.write_obj(folder / "clean.obj", io.MeshData(V, F))
    spoilt = np.concatenate([F, F[:1]])
    spoilt[5] = spoilt[5, ::-1]
    io.write_ply(folder / "sub" / "spoilt.ply", io.MeshData(V, spoilt))
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (folder / "text.obj").write_text("f one two three\n")
    return folder


def write_archive(path, models):
    """Write models, by their names, to an archive."""
    if path.suffix == ".parquet":
        rows = [{"name": name.removesuffix(".glb"), "glb": data} for name, data in models.items()]
        pytest.importorskip("pyarrow.parquet").write_table(pytest.importorskip("pyarrow").Table.from_pylist(rows), path)
        return
    with tarfile.open(path, "w") as tar:
        for name, data in models.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, streams.BytesIO(data))


def read_archive(path):
    """The maps in an archive of results, their libraries and images, by name."""
    found = {}
    for result in read_results(path):
        folder = result.key.rpartition("/")
        found[f"{result.key}.{result.form}"] = result.data
        found |= {folder[0] + folder[1] + name: data for name, data in result.files.items()}
    if path.suffix == ".tar":
        with tarfile.open(path) as tar:
            named = [name for name in tar.getnames() if not name.endswith(".json")]
            assert found == {name: tar.extractfile(name).read() for name in named}
    return found


def settings(**options):
    return batch.Settings(unwrap={"resolution": 256, **options})


def test_records_of_models_and_of_failures(models, tmp_path):
    progress = batch.run(models, tmp_path / "out", settings(max_stretch=1.3), jobs=2)
    assert (progress.total, progress.solved, progress.failed) == (4, 2, 2)
    expected = unwrap(V, F, max_stretch=1.3, resolution=256)
    written = io.read_mesh(tmp_path / "out/results/clean.obj/map.obj")
    np.testing.assert_array_equal(written.vt[written.FT], expected.uvs[expected.indices])
    record = record_of(tmp_path / "out", "clean.obj")
    assert record["outcome"] == "bijective"
    assert record["certified"] is True
    assert record["status"] == "unwrapped"
    assert record["charts"] == expected.n_charts
    assert (record["stretch"], record["isometric"]) == (expected.stretch.p99, expected.stretch.worst)
    assert (record["seam_length"], record["utilisation"]) == (expected.seam_length, expected.utilisation)
    assert (record["vertices"], record["triangles"], record["cleaned"]) == (len(V), len(F), None)
    assert set(record) <= set(batch.COLUMNS)
    spoilt = record_of(tmp_path / "out", "sub/spoilt.ply")
    assert spoilt["certified"] is True
    assert spoilt["cleaned"] == "repeated triangles excluded: 1, triangles reversed: 1"
    for name, words in (("flat.obj", "degenerate"), ("text.obj", "line 1")):
        failed = record_of(tmp_path / "out", name)
        assert failed["outcome"] == "invalid"
        assert words in failed["error"]


def test_finished_models_are_skipped_unless_an_option_changes(models, tmp_path):
    out = tmp_path / "out"
    batch.run(models, out, settings(), jobs=1)
    assert batch.run(models, out, settings(), jobs=1).resumed == 4
    assert batch.run(models, out, settings(max_stretch=1.2), jobs=1).resumed == 0


@linux
@pytest.mark.parametrize(("how", "status"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 2)])
def test_a_stopped_run_is_continued(models, tmp_path, capsys, how, status):
    for k in range(6):
        io.write_obj(models / f"more{k}.obj", io.MeshData(V * (k + 2), F))
    out = tmp_path / "out"
    command = ["batch", models, "-o", out, "--unwrap", "--resolution", "256", "-j", "1"]
    process = subprocess.Popen([sys.executable, "-m", "quasiharmonic", *map(str, command)], stdout=subprocess.DEVNULL)
    while not list(out.glob("results/*/record.json")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(how)
    assert process.wait() == status
    finished = len(list(out.glob("results/**/record.json")))
    assert finished > 0
    assert run(*command) == 1
    assert f"{finished} of them done before" in capsys.readouterr().out
    rows = list(batch.read_table(out / "records.csv"))
    assert len(rows) == 10
    assert sum(row["certified"] is True for row in rows) == 8


def test_archives_and_shards(models, tmp_path):
    data = (models / "clean.obj").read_bytes()
    write_archive(tmp_path / "models.tar", {f"{name}.obj": data for name in ("one", "two", "three")})
    assert batch.run(tmp_path / "models.tar", tmp_path / "out", settings(), jobs=1).solved == 3
    with tarfile.open(tmp_path / "out/results/models.tar") as tar:
        assert {"one.obj", "one.json", "three.obj"} <= set(tar.getnames())
    for shard in ("1/2", "2/2"):
        batch.run(models, tmp_path / "shards", settings(), jobs=1, shard=shard)
    merged = batch.merge([tmp_path / "shards"], tmp_path / "shards")
    assert (merged.total, merged.solved) == (4, 2)


@pytest.mark.parametrize("suffix", [".tar", ".parquet"])
def test_results_in_archives_have_the_materials_of_each_model(tmp_path, suffix):
    picture = b"\x89PNG\r\n\x1a\n of a wall"
    made = square()
    made.tree["images"] = [{"bufferView": made.view(picture), "mimeType": "image/png"}]
    made.tree["textures"] = [{"source": 0}]
    looks = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    made.tree["materials"] = [{"name": "map-texture", **looks}]
    made.tree["meshes"][0]["primitives"][0]["material"] = 0
    models = {"a b.glb": made.glb(), "a_b.glb": made.glb(), "in/plain.glb": square().glb(), "in/last.glb": made.glb()}
    # The results of the first models are copied when the archive has more of them.
    for count in (2, 4):
        some = dict(list(models.items())[:count])
        write_archive(tmp_path / f"set{suffix}", some)
        progress = batch.run(tmp_path / f"set{suffix}", tmp_path / "out", settings(), jobs=1)
        assert (progress.solved, progress.resumed) == (count, count - 2)
    found = read_archive(tmp_path / f"out/results/set{suffix}")
    names = {"a b": "a%20b", "a_b": "a_b", "in/last": "in/last"}
    assert set(found) == {f"{key}.obj" for key in [*names, "in/plain"]} | {
        f"{name}.texture{end}" for name in names.values() for end in (".mtl", "-0.png")
    }
    for key, name in names.items():
        stem = f"{name.rpartition('/')[2]}.texture".encode()
        assert found[f"{key}.obj"].startswith(b"mtllib " + stem + b".mtl\n")
        assert b"usemtl map-texture\n" in found[f"{key}.obj"]
        library = found[f"{name}.texture.mtl"]
        assert library.startswith(b"newmtl map-texture\n")
        assert library.endswith(b"map_Kd " + stem + b"-0.png\n")
        assert found[f"{name}.texture-0.png"] == picture
    assert b"mtllib" not in found["in/plain.obj"]


def test_meshes_and_instances_of_gltf_files_are_distinguished(tmp_path):
    """As `unwrap` of the file does; a lightmap has a place for each occurrence of a mesh."""
    made = square()
    made.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [2, 0, 0]}]
    (tmp_path / "set").mkdir()
    (tmp_path / "set/touching.glb").write_bytes(touching_squares().glb())
    (tmp_path / "set/twice.glb").write_bytes(made.glb())
    batch.run(tmp_path / "set", tmp_path / "out", settings(lightmap=True), jobs=1)
    assert record_of(tmp_path / "out", "touching.glb")["charts"] == 2
    assert record_of(tmp_path / "out", "twice.glb")["vertices"] == 8
    assert len(io.read_mesh(tmp_path / "out/results/twice.glb/map.obj").V) == 8


def test_options_may_refer_to_the_file(tmp_path):
    (tmp_path / "set").mkdir()
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl a\ns 1\nf 1 2 3\nusemtl b\ns 2\nf 1 3 4\n"
    (tmp_path / "set/two.obj").write_text(text)
    batch.run(tmp_path / "set", tmp_path / "tiles", settings(tile_by="material"), jobs=1)
    vt = io.read_mesh(tmp_path / "tiles/results/two.obj/map.obj").vt
    assert set(np.floor(vt[:, 0])) == {0, 1}
    batch.run(tmp_path / "set", tmp_path / "edges", settings(hard_edges="file"), jobs=1)
    assert record_of(tmp_path / "edges", "two.obj")["charts"] == 2


def test_the_command_reports_charts_and_cleaning(models, tmp_path, capsys):
    out = tmp_path / "out"
    options = "--unwrap", "--max-stretch", "1.3", "--resolution", "256x128", "--symmetry", "none", "--report"
    assert run("batch", models, "-o", out, "-j", "1", *options) == 1
    assert "2 of 4 problems have a certified bijective map" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert "<th>charts</th>" in page
    assert "1 of 4 models were cleaned" in page
    assert "triangles reversed: 1" in page
    assert "Distribution of distortion" not in page
    expected = unwrap(V, F, max_stretch=1.3, resolution=(256, 128), symmetry=None)
    assert record_of(out, "clean.obj")["charts"] == expected.n_charts


def test_the_report_shows_that_a_model_has_no_seams(tmp_path):
    row = {"problem": "a", "outcome": "bijective", "certified": True, "charts": 1, "seam_length": 0.0, "stretch": 1.0}
    batch.write_table(tmp_path / "records.csv", [row])
    assert run("batch", "-o", tmp_path / "records.csv", "--report") == 0
    cells = re.findall("<td[^>]*>([^<]*)</td>", (tmp_path / "report.html").read_text().partition("<th>charts</th>")[2])
    assert cells[:5] == ["a", "1", "0", "1", "–"]


def test_a_length_beyond_double_precision_is_not_recorded(tmp_path):
    (tmp_path / "set").mkdir()
    io.write_obj(tmp_path / "set" / "huge.obj", io.MeshData(V * (1e308 / np.abs(V).max()), F))
    assert batch.run(tmp_path / "set", tmp_path / "out", settings(), jobs=1).solved == 1
    assert record_of(tmp_path / "out", "huge.obj")["seam_length"] is None


def test_other_settings_are_an_error(models, tmp_path, capsys):
    with pytest.raises(ValueError, match="flatten does not apply to unwrap"):
        batch.Settings(unwrap={}, flatten=True)
    with pytest.raises(ValueError, match="max_stretch"):
        batch.Settings(unwrap={"max_stretch": 0.5})
    with pytest.raises(ValueError, match="cannot have the option uv"):
        batch.Settings(unwrap={"uv": []})
    with pytest.raises(ValueError, match="must be a dict"):
        batch.Settings(unwrap=True)
    with pytest.raises(ValueError, match="a lightmap is one texture"):
        batch.Settings(unwrap={"lightmap": True, "tiles": 2})
    assert run("batch", models, "-o", tmp_path / "out", "--max-stretch", "1.3") == 2
    assert "--max-stretch applies only to --unwrap" in capsys.readouterr().err
