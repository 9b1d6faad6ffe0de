"""Nodes in other processes."""
