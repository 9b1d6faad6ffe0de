"""Nodes in other processes: simulated time waits until they have sent what the test declares."""
