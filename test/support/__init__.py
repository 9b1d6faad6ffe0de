"""What tests of several folders share: builders of messages and bags, worlds, processes, forks."""
