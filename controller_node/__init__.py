"""The real-time controller: a thin layer around `lbmpc.controller.step`."""
