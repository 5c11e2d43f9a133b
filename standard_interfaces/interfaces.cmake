# What the folders of this one do: write their package's definitions, and build them for Python.
project(${PACKAGE} C CXX)
set(CMAKE_CXX_STANDARD 17)
# To optimise would take half of the build and gain nothing: these types serve requests of people,
# and the messages of /tf are published as bytes.
add_compile_options(-O0)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(dependency IN LISTS DEPENDENCIES)
  find_package(${dependency} REQUIRED)
endforeach()

# The wheel is for Python: no type supports of C++. Fast DDS asks for those by introspection, too.
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
set(folder "${CMAKE_CURRENT_BINARY_DIR}/definitions")
execute_process(
  COMMAND "${Python3_EXECUTABLE}" "${CMAKE_CURRENT_LIST_DIR}/generate.py" ${PROJECT_NAME} "${folder}"
  OUTPUT_VARIABLE interfaces
  COMMAND_ERROR_IS_FATAL ANY)
list(TRANSFORM interfaces PREPEND "${folder}:")
rosidl_generate_interfaces(${PROJECT_NAME} ${interfaces} DEPENDENCIES ${DEPENDENCIES})
ament_export_dependencies(rosidl_default_runtime)
ament_package()

# Several generated files are compiled as one: their headers take most of the time. The
# descriptions of the types cannot be, because each defines the same static names.
get_directory_property(targets BUILDSYSTEM_TARGETS)
list(FILTER targets INCLUDE REGEX "__rosidl_(generator|typesupport)_")
foreach(target IN LISTS targets)
  get_target_property(sources ${target} SOURCES)
  list(FILTER sources INCLUDE REGEX "__description\\.c$")
  set_source_files_properties(${sources} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
  set_target_properties(${target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 16)
endforeach()

# The wheels' imported targets carry include directories of the machine that built the wheels.
get_directory_property(imported_targets IMPORTED_TARGETS)
foreach(target IN LISTS imported_targets)
  get_target_property(directories ${target} INTERFACE_INCLUDE_DIRECTORIES)
  if(directories AND "${directories}" MATCHES "/opt/python/cp")
    list(FILTER directories EXCLUDE REGEX "/opt/python/cp")
    list(APPEND directories ${Python3_INCLUDE_DIRS} ${Python3_NumPy_INCLUDE_DIRS})
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${directories}")
  endif()
endforeach()
