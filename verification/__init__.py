"""Programs that try to break Tandem and report the outcome. Not installed."""
