"""Estimates of the unknown h behind one contract; their parameters are data."""

from lbmpc.oracles.base import LinearOracle, Oracle, OracleState
from lbmpc.oracles.dnn.oracle import DnnOracle
from lbmpc.oracles.l2nw import L2nwOracle
from lbmpc.oracles.perfect import PerfectOracle

__all__ = ["DnnOracle", "L2nwOracle", "LinearOracle", "Oracle", "OracleState", "PerfectOracle"]
