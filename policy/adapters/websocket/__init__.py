"""Policies on a server that speaks openpi's websocket protocol, and the code shared by client and
server."""
