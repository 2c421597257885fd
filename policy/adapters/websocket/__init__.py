"""Policies on a server by openpi's websocket protocol; code shared by client and server."""
