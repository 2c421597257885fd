"""PX4's side of MAVLink: who is obeyed, what is sent, how often."""
