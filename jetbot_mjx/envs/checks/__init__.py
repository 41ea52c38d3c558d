"""Check a user's task: the results and the purity of its methods, its scene and its episodes."""
