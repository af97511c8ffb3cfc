"""Runs over many hosts: from a design to what each site's containers need, and from what they leave to results."""
