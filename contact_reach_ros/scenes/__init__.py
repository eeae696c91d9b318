"""The paper's environments: free space, ball and wall."""
