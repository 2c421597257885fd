"""Gate courses, the referee that counts gates, and collisions."""
