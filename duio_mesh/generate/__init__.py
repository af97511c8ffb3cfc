"""Topology files for systems of any size: parameters in, a plain document with comments out (docs/generate.md).

Nothing here designs or runs anything, and the same parameters give the same text.
"""
