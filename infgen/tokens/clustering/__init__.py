"""Clustering: logged motion and map lines to the two vocabularies."""
