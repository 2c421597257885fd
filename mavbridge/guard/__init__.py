"""Last stage before the link: decides who controls the vehicle, and limits every action."""
