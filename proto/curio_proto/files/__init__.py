"""Parts of other people's file formats, as far as serving has to read them."""
