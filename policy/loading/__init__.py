"""Loading: from the user's --policy to a policy that is ready to fly."""
