"""From what a user wrote to a policy that is ready to fly."""
