"""The real-time controller: a thin shell around `lbmpc.controller.step`."""
