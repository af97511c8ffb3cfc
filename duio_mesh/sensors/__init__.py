"""Measurements of the outside world: from the bytes of a message to the complete steps of a run. No Zenoh, no clock."""
