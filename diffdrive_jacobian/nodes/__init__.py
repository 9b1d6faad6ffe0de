"""The three nodes: convert a message, call the library, publish."""
