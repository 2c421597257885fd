"""Policies on a server that speaks openpi's websocket protocol, and what both sides of it share."""
