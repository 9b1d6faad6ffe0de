"""The command-line tools: thin shells that read arguments, show progress and give exit codes.

Internal: may change without notice.
"""
