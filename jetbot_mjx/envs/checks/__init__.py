"""Check a task of one's own: what its methods return, its purity, its scene, its episodes."""
