"""Looking at finished files: renders of any glTF, figures, comparison of two, turntables."""
