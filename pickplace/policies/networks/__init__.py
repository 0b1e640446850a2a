"""The networks behind the policies, and the critics."""
