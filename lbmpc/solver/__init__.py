"""The optimisation problem (e:LBMPC) and its solution in real time."""
