"""`tandem live`: one plant's bus in a browser, over the Foxglove WebSocket protocol, and a page that plots it."""
