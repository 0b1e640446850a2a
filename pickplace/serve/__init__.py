"""Services for a robot: JSON lines, HTTP and the live page."""
