"""The Rerun viewer: a live flight, a recorded one, an imagined one."""
