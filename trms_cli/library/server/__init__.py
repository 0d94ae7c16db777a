"""What ``trms serve`` serves: pages of runs, for a browser on this machine and nobody else.

::

    with listening_socket(8760) as own:
        application = application_of(Catalogue([Path("outputs")]), 8760)
        print(application.address)
        serve(application, own)
"""
