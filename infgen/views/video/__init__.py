"""Videos, animated images and figure strips."""
