"""The tutorial runs from its first cell to its last, says what it promises, and stays small."""

import json
import re

import pytest

from conftest import ROOT

NOTEBOOK = ROOT / "docs" / "tutorial.ipynb"


def test_the_tutorial_runs(tmp_path):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(NOTEBOOK, 4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.get("text", "") + str(output.get("data", {}).get("text/plain", "")) for output in outputs)
    assert float(re.search(r"'s12_psnr': ([0-9.]+)", text)[1]) > 22, text
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    curve = [float(error) for error in re.findall(r"([0-9.]+) dB", text.split("exact ")[1])]
    assert curve[-1] > curve[0] + 1, curve


def test_the_outputs_that_are_kept_are_small():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert NOTEBOOK.stat().st_size < 400_000 and any(cell.get("outputs") for cell in cells)
