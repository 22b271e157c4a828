"""The policy process, and the policy bundles that it runs."""
