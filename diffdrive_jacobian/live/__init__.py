"""A page in the browser that shows robots and steers them, or plays a bag.

The server runs in a thread of its own and listens on 127.0.0.1 only. Nodes store their latest state in a
`Session`, and take the commands of the page from it.

Internal: may change without notice.
"""
