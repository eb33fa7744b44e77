"""Oracles: estimates of the unknown h behind one interface. Their parameters are data."""

from lbmpc.oracles.base import HiddenSet, Oracle, OracleState, Verdict
from lbmpc.oracles.constant import ConstantOracle
from lbmpc.oracles.dnn.oracle import DnnOracle
from lbmpc.oracles.l2nw import L2nwOracle
from lbmpc.oracles.linear import LinearOracle
from lbmpc.oracles.perfect import PerfectOracle

__all__ = [
    "ConstantOracle",
    "DnnOracle",
    "HiddenSet",
    "L2nwOracle",
    "LinearOracle",
    "Oracle",
    "OracleState",
    "PerfectOracle",
    "Verdict",
]
