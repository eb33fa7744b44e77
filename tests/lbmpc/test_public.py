"""The public names of `lbmpc` and `tandem`: they exist, are imported lazily, and match the docstrings."""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lbmpc
import tandem
from tests.helpers.interpreter import imported
from tests.helpers.paths import DOCS


def test_the_solve_of_the_docstring_and_of_the_page_gives_an_input() -> None:
    (block,) = re.findall(r"\n\n((?:    .*\n|\n)+)", lbmpc.__doc__ or "")
    code = textwrap.dedent(block)
    page = (DOCS / "tutorials/python.md").read_text()
    assert f"```python\n{code.strip()}\n```" in page
    names: dict[str, object] = {}
    exec(code, names)
    np.testing.assert_allclose(np.asarray(names["u"]), [1.1595349], atol=1e-6)


@pytest.mark.parametrize("package", [lbmpc, tandem])
def test_every_public_name_exists_and_matches_the_type_checkers_import(package: ModuleType) -> None:
    tree = ast.parse(Path(package.__file__ or "").read_text())
    (checked,) = [node for node in tree.body if isinstance(node, ast.If)]
    imported = {
        alias.name: node.module
        for node in checked.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(imported) == sorted(package.__all__)
    for name, module in imported.items():
        assert getattr(package, name) is getattr(sys.modules[str(module)], name)
        assert name in dir(package)
    with pytest.raises(AttributeError, match="has no attribute 'Lop'"):
        _ = package.Lop


def test_names_are_imported_on_first_use() -> None:
    assert not imported("import lbmpc, tandem") & {"numpy", "casadi", "torch", "matplotlib", "scipy"}
