"""Initial proposals: candidate motions of every superpixel and the choice among them."""
