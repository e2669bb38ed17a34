"""Visual hull of the masks, and parts too thin for its grid."""
