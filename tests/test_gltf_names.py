"""Materials of equal names in glTF files stay different in statements."""

from __future__ import annotations

from quasiharmonic import io
from quasiharmonic.io.models.materials import label_materials
from quasiharmonic.surfaces import starfish
from shared.gltf_files import Gltf


def test_materials_of_equal_names_are_told_apart(tmp_path):
    made = Gltf()
    V, F = starfish(2, 12)
    table = {"POSITION": made.accessor(V.astype("f4"))}
    halves = F[: len(F) // 2], F[len(F) // 2 :]
    made.mesh(
        *(
            {"attributes": table, "indices": made.accessor(f.ravel().astype("u2")), "material": k}
            for k, f in enumerate(halves)
        )
    )
    made.tree["materials"] = [{"name": "same"}, {"name": "same"}]
    path = tmp_path / "in.glb"
    path.write_bytes(made.glb())
    label, names = label_materials(io.read_mesh(path))
    assert [names[k] for k in (label[0], label[-1])] == ["same.0", "same.1"]
