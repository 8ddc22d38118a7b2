"""The viewer in a browser: requests, order of drawing, and the page."""
