"""Many runs together: compare, query, tag, and their history."""
