"""What the nodes share: parameters, message conversion, the node's base, the runner."""
