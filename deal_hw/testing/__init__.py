"""Contract suites for new robots and transports, and faults to test them with.

A test class inherits a suite and names the object under test; pytest is imported by the suites only, so that
the faults can also be used without pytest::

    from deal_hw.testing.transport_suite import TransportPair, TransportSuite

    class TestMyTransport(TransportSuite):
        @pytest.fixture
        def pair(self): ...
"""
