"""Commands beside the flight itself, a function each.

A problem of the user, the vehicle or a file is raised as MavbridgeError or PolicyError, which
``main`` shows in one message.
"""
