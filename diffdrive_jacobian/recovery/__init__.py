"""Bags from what a crash, a full disk or a cut has left."""
