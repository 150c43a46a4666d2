"""Stage ``train``: token shards and vocabularies to weights."""
