"""Pictures, the page, point clouds, the result folder and its check."""
