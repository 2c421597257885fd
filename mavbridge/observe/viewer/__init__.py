"""The Rerun viewer: a live flight, or a recorded one."""
