"""Audits: what comes out again is told from what does not."""

import experiments
import pytest
from experiments import CONFIGS, chapter, experiment, report, run_and_read, stored

from lifelong_lib.reproduction.runs import NotStored, run_grid


def audited(root, options, monkeypatch, number):
    """Audits two stored grids; before the second the code changes, so that its curves come out differently."""
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
    before = stored(root)
    options(audit=number)
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
        monkeypatch.setattr(experiments, "SCALE", 4.0)
    assert stored(root) == before
    return report(root)["audited"], report(root, name="second")["audited"]


def test_audit_tells_equal_from_different(root, options, monkeypatch):
    found = [[(row["same"], row["stale"], [text[:8] for text in row["differs"]]) for row in rows]
             for rows in audited(root, options, monkeypatch, 8)]
    assert found == [[(True, False, [])] * 4, [(False, True, ["curve by"])] * 4]
    with pytest.raises(NotStored, match="2 of 6"):
        run_and_read(root, seeds=3)


def test_audit_draws_k_runs_of_the_chapter(root, options, monkeypatch):
    first, second = audited(root, options, monkeypatch, 3)
    assert len(first) + len(second) == 3
