"""Damaged files as input of the command: the campaign detects errors. A small campaign runs in the tests."""

from __future__ import annotations

import re

import pytest

import damaged_files

pytestmark = pytest.mark.long

CALLS = [(kind, call) for kind, calls in damaged_files.CALLS.items() for call in calls]


@pytest.mark.parametrize(("kind", "call"), CALLS)
def test_undamaged_files_are_accepted(kind, call, monkeypatch):
    monkeypatch.setattr(damaged_files, "damaged", lambda rng, data: data)
    monkeypatch.setitem(damaged_files.CALLS, kind, [call])
    (trial,) = damaged_files.trials([f"{kind}:0"])
    assert (trial.status, trial.fault) == (0, ""), trial.said


@pytest.mark.parametrize("kind", damaged_files.CALLS)
def test_damaged_files_are_rejected_or_read_correctly(kind):
    trials = list(damaged_files.trials([f"{kind}:{seed}" for seed in range(100, 103)]))
    assert not [(trial.name, trial.fault, trial.said) for trial in trials if trial.fault]
    assert {trial.status for trial in trials} & {1, 2}


@pytest.mark.parametrize(
    ("trouble", "fault"),
    [
        ("raise KeyError('lost')", "exit status 70"),
        ("print('Warning: hm')", "a traceback or a warning"),
        ("raise SystemExit(2)", "a refusal that does not say who refuses"),
        ("print('qhm map: no'); open('out.obj', 'w').close(); raise SystemExit(2)", "left behind: out.obj"),
        ("print('qhm map: ' + 'no' * 2000); raise SystemExit(2)", "a refusal of 4010 characters"),
        ("__import__('signal').raise_signal(15)", "exit status -15"),
        ("__import__('time').sleep(60)", "exit status -9"),
        ("pass", "nothing written"),
        ("open('out.obj', 'w').write('v 0')", "written, and cannot be read: out.obj: "),
        ("__import__('shutil').copy('turned.obj', 'out.obj')", "certified, and not injective"),
    ],
)
def test_errors_are_detected(trouble, fault, tmp_path, monkeypatch):
    def fail(arguments):
        exec(trouble)
        return 0

    monkeypatch.setattr(damaged_files, "qhm", fail)
    monkeypatch.setattr(damaged_files, "SECONDS", 2.0)
    monkeypatch.setitem(damaged_files.CALLS, "mesh.obj", ["map {} -o out.obj"])
    files = dict(damaged_files.valid_files())
    files["turned.obj"] = re.sub(rb"vt (\S+) (\S+)", rb"vt \2 \1", files["mesh.obj"])
    assert fault in damaged_files.attempt("mesh.obj:0", files, tmp_path).fault.replace(f"{tmp_path}/", "")


def test_a_run_lists_its_failures(monkeypatch, capsys):
    assert damaged_files.main(["-n", "2", "--kinds", "handles.txt"]) == 0
    assert "0 failures among 2 files" in capsys.readouterr().out
    monkeypatch.setattr(damaged_files, "qhm", lambda arguments: 5)
    assert damaged_files.main(["--case", "handles.txt:3"]) == 1
    assert "handles.txt:3: exit status 5: qhm " in capsys.readouterr().out
