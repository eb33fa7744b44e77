"""What people and other tools see of a run: channels of JSON with schemas.

The log, the live socket and exports share it. `run_log.views.views.Views` is the interface.
"""
