"""Views of a run for people and other tools: channels of JSON with schemas.

The log, the live socket and exports share them. `run_log.views.views.Views` is the interface.
"""
