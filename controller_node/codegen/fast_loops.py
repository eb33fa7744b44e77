"""Faster versions of two loops in CasADi's generated C: the dense product and tanh.

Both replacements, in `fast_loops.c`, are exact to rounding. All other code is unchanged. If a version of CasADi
generates other text, it is left unchanged, which is only slower.
"""

from __future__ import annotations

import re
from pathlib import Path

# A compiled kernel is cached by its text, so comments are removed. Editing them then recompiles nothing.
_COMMENTS = re.compile(r"(?:^(?://.*)?\n)+", re.MULTILINE)
_, _VECTORS, _DENSE_PRODUCT, _TANH = _COMMENTS.split(Path(__file__).with_suffix(".c").read_text("utf-8"))

_CASADIS_PRODUCT = re.compile(r"void casadi_mtimes_dense\(.*?\n}\n", re.DOTALL)
_TANH_LOOP = re.compile(r"for \(i=0, rr=(\w+), cs=(\w+); i<(\d+); \+\+i\) \*rr\+\+ ?= ?tanh\( ?\*cs\+\+ ?\);")


def with_fast_loops(source: str) -> str:
    """Return the generated C with its dense product and its loops of tanh replaced."""
    source, products = _CASADIS_PRODUCT.subn(lambda _match: _DENSE_PRODUCT, source, count=1)
    source, tanhs = _TANH_LOOP.subn(r"tandem_tanh(\2, \1, \3);", source)
    head, found, rest = source.partition("void casadi_")
    if not found or not (products or tanhs):
        return source
    return head + _VECTORS + (_TANH if tanhs else "") + found + rest
