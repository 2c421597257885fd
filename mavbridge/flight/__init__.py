"""One flight: camera image -> feature -> chunk of actions -> sticks."""
